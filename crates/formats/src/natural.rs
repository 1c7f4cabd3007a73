//! The natural order of names, which compares the numbers in them by value.

/// A key that sorts names in natural order: `img2` before `img10`.
pub fn natural_key(name: &str) -> Vec<(String, usize, String)> {
    let mut key = Vec::new();
    let mut rest = name;
    while !rest.is_empty() {
        let start = rest.find(|c: char| c.is_ascii_digit()).unwrap_or(rest.len());
        let (text, digits) = rest.split_at(start);
        let end = digits.find(|c: char| !c.is_ascii_digit()).unwrap_or(digits.len());
        let (digits, tail) = digits.split_at(end);
        let number = digits.trim_start_matches('0');
        key.push((text.to_owned(), number.len(), number.to_owned()));
        rest = tail;
    }
    key
}

#[cfg(test)]
mod tests {
    use super::natural_key;

    #[test]
    fn numbers_are_compared_by_value() {
        let mut names =
            ["img10.png", "img2.png", "img1.png", "a", "img010b", "img9999999999999999999999"];
        names.sort_by_cached_key(|name| natural_key(name));
        let sorted =
            ["a", "img1.png", "img2.png", "img10.png", "img010b", "img9999999999999999999999"];
        assert_eq!(names, sorted);
    }
}
