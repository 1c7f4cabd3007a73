//! Validated text values: labels, hashes and times, and the errors of invalid ones.

use std::fmt;
use std::io::{self, BufReader, Read, Write};
use std::str::FromStr;
use std::time::Duration;

use derive_more::Display;
use jiff::fmt::temporal::Pieces;
use serde::Serialize;
use serde_with::{DeserializeFromStr, SerializeDisplay};

use reconstruction::schedule::Schedule;

/// Describes a type in JSON schemas: the type, the name of its schema, and the schema.
macro_rules! text_schema {
    ($type:ty, $name:literal, $schema:tt) => {
        impl schemars::JsonSchema for $type {
            fn schema_name() -> std::borrow::Cow<'static, str> {
                $name.into()
            }

            fn json_schema(_: &mut schemars::SchemaGenerator) -> schemars::Schema {
                schemars::json_schema!($schema)
            }
        }
    };
}
pub(super) use text_schema;

/// The error of a text that can't be parsed. It explains the expected form.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct InvalidText(String);

impl InvalidText {
    pub(super) fn new(text: String) -> Self {
        Self(text)
    }
}

/// Checks the name of a `kind` of thing: a plain word, so that it needs no escapes anywhere.
pub(super) fn plain_name(text: &str, kind: &str, longest: usize) -> Result<String, InvalidText> {
    let is_good = |byte: u8| byte.is_ascii_lowercase() || byte.is_ascii_digit() || byte == b'-';
    if (1..=longest).contains(&text.len()) && text.bytes().all(is_good) {
        return Ok(text.to_owned());
    }
    let start: String = text.chars().take(60).collect();
    Err(InvalidText(format!(
        "{start:?} is not a valid {kind} name: use 1 to {longest} characters of a-z, 0-9 and -"
    )))
}

/// A violation in a request, and its place.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, schemars::JsonSchema)]
pub struct InvalidField {
    /// JSON pointer (RFC 6901) into the request.
    pub pointer: String,
    /// The problem, and the expected value.
    pub detail: String,
}

impl InvalidField {
    pub fn new(pointer: impl Into<String>, detail: impl Into<String>) -> Self {
        Self { pointer: pointer.into(), detail: detail.into() }
    }

    /// All violations of a schedule, with pointers relative to it.
    pub fn schedule_errors(schedule: &Schedule) -> Vec<Self> {
        let faults = schedule.faults().into_iter();
        faults.map(|(pointer, error)| Self::new(pointer, error.to_string())).collect()
    }

    /// Prepends `parent` to the pointer.
    pub fn under(mut self, parent: &str) -> Self {
        self.pointer.insert_str(0, parent);
        self
    }
}

/// A name that a user gives to a resource. It is never used as a path.
#[derive(Debug, Clone, PartialEq, Eq, Display, SerializeDisplay, DeserializeFromStr)]
pub struct Label(String);

impl Label {
    /// Longest label in characters.
    pub const MAX_CHARS: usize = 200;

    pub fn as_str(&self) -> &str {
        &self.0
    }
}

text_schema!(Label, "Label", {
    "type": "string",
    "description": "A name for people, not blank and without control characters.",
    "minLength": 1,
    "maxLength": Self::MAX_CHARS,
    "pattern": r"^[^\x00-\x1f\x7f-\x9f]*[^\s\x00-\x1f\x7f-\x9f][^\x00-\x1f\x7f-\x9f]*$",
});

impl FromStr for Label {
    type Err = InvalidText;

    fn from_str(text: &str) -> Result<Self, InvalidText> {
        let length = text.chars().count();
        if text.trim().is_empty() {
            return Err(InvalidText(
                "the text is blank: omit it, or use at least one visible character".into(),
            ));
        }
        if length > Self::MAX_CHARS {
            return Err(InvalidText(format!(
                "the text has {length} characters; at most {} are accepted",
                Self::MAX_CHARS
            )));
        }
        match text.chars().position(char::is_control) {
            Some(position) => Err(InvalidText(format!(
                "the text contains a control character at position {position}: use printable characters only"
            ))),
            None => Ok(Self(text.to_owned())),
        }
    }
}

/// The SHA-256 hash of a file, which is also its address in the store.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[derive(SerializeDisplay, DeserializeFromStr)]
pub struct Sha256([u8; 32]);

impl Sha256 {
    /// The hash with these 32 bytes.
    pub fn new(bytes: [u8; 32]) -> Self {
        Self(bytes)
    }

    pub fn bytes(&self) -> [u8; 32] {
        self.0
    }

    /// Hashes all remaining bytes of a reader, and counts them.
    pub fn of_reader(reader: &mut impl Read) -> io::Result<(Self, u64)> {
        let mut hashed = HashingWriter::new(io::sink());
        let size = io::copy(&mut BufReader::with_capacity(256 * 1024, reader), &mut hashed)?;
        Ok((hashed.sha256(), size))
    }

    /// The hash of these bytes.
    pub fn of(bytes: &[u8]) -> Self {
        use sha2::Digest;
        Self(sha2::Sha256::digest(bytes).into())
    }
}

/// Hashes and counts the bytes that it passes to a writer.
#[derive(Debug)]
pub struct HashingWriter<W> {
    pub writer: W,
    hasher: sha2::Sha256,
    size: u64,
}

impl<W> HashingWriter<W> {
    pub fn new(writer: W) -> Self {
        Self { writer, hasher: sha2::Sha256::default(), size: 0 }
    }

    /// Number of bytes so far.
    pub fn size(&self) -> u64 {
        self.size
    }

    /// Hash of the bytes so far.
    pub fn sha256(&self) -> Sha256 {
        use sha2::Digest;
        Sha256(self.hasher.clone().finalize().into())
    }
}

impl<W: Write> Write for HashingWriter<W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        use sha2::Digest;
        let count = self.writer.write(bytes)?;
        self.hasher.update(&bytes[..count]);
        self.size += count as u64;
        Ok(count)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.writer.flush()
    }
}

impl fmt::Display for Sha256 {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&hex::encode(self.0))
    }
}

text_schema!(Sha256, "Sha256", {
    "type": "string",
    "pattern": "^[0-9a-f]{64}$",
    "example": "9f86d081884c7d659a2feaa0c55ad015a3bf4f1b2b0b822cd15d6c15b0f00a08",
});

impl FromStr for Sha256 {
    type Err = InvalidText;

    fn from_str(text: &str) -> Result<Self, InvalidText> {
        let mut bytes = [0; 32];
        let upper = text.bytes().any(|digit| digit.is_ascii_uppercase());
        if upper || hex::decode_to_slice(text, &mut bytes).is_err() {
            return Err(InvalidText(format!(
                "{:?} is not a SHA-256 hash: 64 lower-case hexadecimal digits are expected",
                text.chars().take(80).collect::<String>()
            )));
        }
        Ok(Self(bytes))
    }
}

/// A time in milliseconds since 1970-01-01T00:00:00Z. In JSON it is RFC 3339 text in UTC.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
#[derive(SerializeDisplay, DeserializeFromStr)]
pub struct Timestamp(pub i64);

text_schema!(Timestamp, "Moment", {
    "type": "string", "format": "date-time", "example": "2026-11-21T10:39:01.000Z",
});

impl FromStr for Timestamp {
    type Err = InvalidText;

    fn from_str(text: &str) -> Result<Self, InvalidText> {
        let time: Result<jiff::Timestamp, _> = text.parse();
        time.map(|time| Self(time.as_millisecond())).map_err(|_| {
            let shown: String = text.chars().take(80).collect();
            if Pieces::parse(text).is_ok_and(|pieces| pieces.time().is_some()) {
                let (first, last) = (jiff::Timestamp::MIN, jiff::Timestamp::MAX);
                return InvalidText(format!(
                    "{shown:?} is not from {first:.0} to {last:.0}, or has no offset such as Z"
                ));
            }
            InvalidText(format!(
                "{shown:?} is not a time: RFC 3339 is expected, such as 2026-11-21T10:39:01Z"
            ))
        })
    }
}

impl Timestamp {
    /// The current time of the system clock.
    pub fn now() -> Self {
        Self(jiff::Timestamp::now().as_millisecond())
    }

    fn to_jiff(self) -> jiff::Timestamp {
        jiff::Timestamp::from_millisecond(self.0).unwrap_or(jiff::Timestamp::MAX)
    }

    /// The time in the format of HTTP headers (RFC 9110).
    pub fn http_date(self) -> String {
        let printer = jiff::fmt::rfc2822::DateTimePrinter::new();
        // Fails only before the year 0.
        printer.timestamp_to_rfc9110_string(&self.to_jiff()).unwrap_or_default()
    }

    /// The time that is `delay` later.
    pub fn after(self, delay: Duration) -> Self {
        Self(self.0.saturating_add(i64::try_from(delay.as_millis()).unwrap_or(i64::MAX)))
    }

    /// Seconds since `earlier`, at least 0.
    #[allow(clippy::cast_precision_loss)]
    pub fn seconds_since(self, earlier: Self) -> f64 {
        (self.0 - earlier.0).max(0) as f64 / 1000.0
    }
}

impl fmt::Display for Timestamp {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:.3}", self.to_jiff())
    }
}

/// The text of an error and its causes.
pub fn with_causes(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    for cause in std::iter::successors(error.source(), |cause| cause.source()) {
        let cause = cause.to_string();
        if !text.contains(&cause) {
            text += &format!(": {cause}");
        }
    }
    text
}

/// Replaces each absolute path in a text by its last component. Error messages stay useful, and do not reveal the
/// folders of the service.
pub fn without_paths(text: &str) -> String {
    let mut clean = String::with_capacity(text.len());
    let mut rest = text;
    while let Some(start) = start_of_path(rest) {
        let (before, path) = rest.split_at(start);
        let end = path.find(ends_path).unwrap_or(path.len());
        let (path, after) = path.split_at(end);
        clean.push_str(before);
        clean.push_str(path.trim_end_matches('/').rsplit('/').next().unwrap_or_default());
        rest = after;
    }
    clean + rest
}

/// Byte index of the first path with at least two components.
fn start_of_path(text: &str) -> Option<usize> {
    let slashes = text.match_indices('/').map(|(at, _)| at);
    slashes.into_iter().find(|&at| {
        let before = text[..at].chars().next_back();
        let path = &text[at + 1..];
        let end = path.find(ends_path).unwrap_or(path.len());
        // "and/or" and "m/s" are not paths; the slashes of "file:///x/y" and "/x/y" start one.
        !before.is_some_and(|c| c.is_alphanumeric()) && path[..end].trim_matches('/').contains('/')
    })
}

fn ends_path(c: char) -> bool {
    c.is_whitespace() || matches!(c, '"' | '\'' | '`' | ':' | ',' | ';' | '(' | ')' | '<' | '>')
}

#[cfg(test)]
mod tests {
    use super::{Label, Sha256, Timestamp, without_paths};

    #[test]
    fn times_are_formatted_as_rfc_3339() {
        assert_eq!(Timestamp(0).to_string(), "1970-01-01T00:00:00.000Z");
        assert_eq!(Timestamp(951_827_696_789).to_string(), "2000-02-29T12:34:56.789Z");
        assert_eq!(Timestamp(1_798_761_599_999).to_string(), "2026-12-31T23:59:59.999Z");
        for text in ["2000-02-29T12:34:56.789Z", "2000-02-29T13:34:56.789+01:00"] {
            assert_eq!(text.parse(), Ok(Timestamp(951_827_696_789)), "{text}");
        }
        for bad in ["", "2000-02-30T00:00:00Z", "yesterday", "2000-02-29", "951827696"] {
            assert!(bad.parse::<Timestamp>().is_err(), "{bad}");
        }
    }

    #[test]
    fn hashes_print_and_parse() {
        let empty = "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855";
        assert_eq!(Sha256::of(b"").to_string(), empty);
        assert_eq!(empty.parse::<Sha256>().unwrap(), Sha256::of(b""));
        for bad in ["", "e3b0", &empty.to_uppercase(), &format!("{empty}0"), "../../etc/passwd"] {
            assert!(bad.parse::<Sha256>().is_err(), "{bad}");
        }
    }

    #[test]
    fn labels_are_short_printable_text() {
        assert!("run 7, f/8, \u{3b1} = 3".parse::<Label>().is_ok());
        assert!("../../etc/passwd".parse::<Label>().is_ok(), "a label is not a path");
        for bad in ["", "  ", "a\nb", "a\0b", "\u{1b}[31m", &"x".repeat(201)] {
            assert!(bad.parse::<Label>().is_err(), "{bad:?}");
        }
    }

    #[test]
    fn paths_are_reduced_to_their_last_component() {
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
