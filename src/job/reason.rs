//! Reasons as users may read them.

/// The text with each absolute path in it cut down to its last part: how the folders of the service
/// are named is nobody's business, and what failed can still be told.
#[must_use]
pub fn without_paths(text: &str) -> String {
    let mut clean = String::with_capacity(text.len());
    let mut rest = text;
    while let Some(at) = start_of_path(rest) {
        let (before, path) = rest.split_at(at);
        let end = path.find(ends_path).unwrap_or(path.len());
        let (path, after) = path.split_at(end);
        clean.push_str(before);
        clean.push_str(path.trim_end_matches('/').rsplit('/').next().unwrap_or_default());
        rest = after;
    }
    clean + rest
}

/// Where the first path with at least two parts begins.
fn start_of_path(text: &str) -> Option<usize> {
    let slashes = text.match_indices('/').map(|(at, _)| at);
    slashes.into_iter().find(|&at| {
        let before = text[..at].chars().next_back();
        let path = &text[at + 1..];
        let end = path.find(ends_path).unwrap_or(path.len());
        // "and/or" and "s/m" are no paths; the slashes of "file:///x/y" and "/x/y" begin one.
        !before.is_some_and(|c| c.is_alphanumeric()) && path[..end].trim_matches('/').contains('/')
    })
}

fn ends_path(c: char) -> bool {
    c.is_whitespace() || matches!(c, '"' | '\'' | '`' | ':' | ',' | ';' | '(' | ')' | '<' | '>')
}

#[cfg(test)]
mod tests {
    use super::without_paths;

    #[test]
    fn paths_go_and_what_failed_stays() {
        for (text, clean) in [
            ("can't write /srv/sci/tmp/019a: No space left", "can't write 019a: No space left"),
            ("there is no file /nowhere/lib.so; name it", "there is no file lib.so; name it"),
            ("load \"/a/b/c.so\" (/x/y): both/or", "load \"c.so\" (y): both/or"),
            ("/a/b and /c/d/", "b and d"),
            ("file:///root/x/y failed", "file:y failed"),
            ("speed in m/s, 1/2, / and /tmp", "speed in m/s, 1/2, / and /tmp"),
            ("\u{e9}/\u{e9}/ \u{e9} /\u{e9}/\u{e9}", "\u{e9}/\u{e9}/ \u{e9} \u{e9}"),
            ("", ""),
        ] {
            assert_eq!(without_paths(text), clean);
        }
    }
}
