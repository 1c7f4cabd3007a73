//! Content negotiation (RFC 9110): the weights that a client gives to media types.

use axum::http::{HeaderMap, HeaderName, header};

use super::error::{ApiError, Code, Result};
use formats::display::Encoding;

/// The items of a list header with their weights from 0 to 1, in lower case and without other parameters.
pub(super) fn weighted(
    headers: &HeaderMap,
    name: HeaderName,
) -> impl Iterator<Item = (String, f32)> {
    let lists = headers.get_all(name).iter().filter_map(|value| value.to_str().ok());
    lists.flat_map(|list| list.split(',')).filter_map(|item| {
        let mut parts = item.split(';').map(|part| part.trim().to_ascii_lowercase());
        let item = parts.next().filter(|item| !item.is_empty())?;
        let weight = parts.find_map(|part| part.strip_prefix("q=").map(str::to_owned));
        Some((item, weight.and_then(|weight| weight.trim().parse().ok()).unwrap_or(1.0)))
    })
}

/// The encoding of a picture that the client prefers; of several, the one that it names, then the first of
/// [`Encoding::ALL`].
///
/// Errors: 406 if it accepts none.
pub(super) fn picture_encoding(headers: &HeaderMap) -> Result<Encoding> {
    let ranges: Vec<(String, f32)> = weighted(headers, header::ACCEPT).collect();
    if ranges.is_empty() {
        return Ok(Encoding::Png);
    }
    // The most specific range that matches determines the weight.
    let preference = |encoding: Encoding| {
        let weight =
            |name: &str| ranges.iter().find(|(range, _)| range == name).map(|range| range.1);
        let named = weight(encoding.media_type()).map(|weight| (weight, 2));
        named
            .or_else(|| weight("image/*").map(|weight| (weight, 1)))
            .or_else(|| weight("*/*").map(|weight| (weight, 0)))
            .filter(|(weight, _)| *weight > 0.0)
    };
    let mut best: Option<((f32, u8), Encoding)> = None;
    for encoding in Encoding::ALL {
        if let Some(preference) = preference(encoding)
            && best.is_none_or(|(other, _)| preference > other)
        {
            best = Some((preference, encoding));
        }
    }
    best.map(|(_, encoding)| encoding).ok_or_else(|| {
        let types = Encoding::ALL.map(Encoding::media_type).join(", ");
        let detail = format!(
            "Accept excludes all types of this picture: add one of {types} to it, or omit it"
        );
        ApiError::new(Code::NotAcceptable, detail)
            .with_header(header::VARY, header::HeaderValue::from_static("accept"))
    })
}

#[cfg(test)]
mod tests {
    use super::picture_encoding;
    use axum::http::HeaderMap;
    use formats::display::Encoding;

    fn headers(name: &str, value: &str) -> HeaderMap {
        HeaderMap::from_iter([(name.parse().unwrap(), value.parse().unwrap())])
    }

    #[test]
    fn the_most_specific_range_determines_the_encoding() {
        for (accept, encoding) in [
            ("*/*", Encoding::Png),
            ("", Encoding::Png),
            ("image/*", Encoding::Png),
            ("image/webp", Encoding::WebP),
            ("IMAGE/JPEG; q=0.4", Encoding::Jpeg),
            ("image/webp;q=0.5, image/jpeg", Encoding::Jpeg),
            ("image/png;q=0, */*;q=0.1", Encoding::WebP),
            ("image/avif,image/webp,image/apng,image/svg+xml,image/*,*/*;q=0.8", Encoding::WebP),
            (
                "image/avif,image/webp,image/png,image/svg+xml,image/*;q=0.8,*/*;q=0.5",
                Encoding::Png,
            ),
            ("text/html, */*;q=0.01", Encoding::Png),
        ] {
            assert_eq!(picture_encoding(&headers("accept", accept)).unwrap(), encoding, "{accept}");
        }
        for none in ["text/html", "image/avif", "*/*;q=0", "image/*;q=0, */*", "application/json"] {
            assert!(picture_encoding(&headers("accept", none)).is_err(), "{none}");
        }
        assert_eq!(picture_encoding(&HeaderMap::new()).unwrap(), Encoding::Png);
    }
}
