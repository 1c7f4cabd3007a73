//! Parses the headers of tus 1.0. All input is untrusted.

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use sha1::Digest;

use engine::job::Sha256;

/// Longest accepted `Upload-Metadata`, in bytes.
const MAX_METADATA: usize = 4096;

/// Supported algorithms of `Upload-Checksum`.
pub const ALGORITHMS: &str = "sha1,sha256";

/// Splits an `Upload-Metadata` into pairs of a name and decoded bytes.
///
/// Errors: the header is too long, repeats a name, or has a value that is not base64.
pub fn metadata(text: &str) -> Result<Vec<(&str, Vec<u8>)>, String> {
    if text.len() > MAX_METADATA {
        return Err(format!("Upload-Metadata has {} bytes, more than {MAX_METADATA}", text.len()));
    }
    let mut pairs: Vec<(&str, Vec<u8>)> = Vec::new();
    for pair in text.split(',').map(str::trim).filter(|pair| !pair.is_empty()) {
        let (name, value) = pair.split_once(' ').unwrap_or((pair, ""));
        if pairs.iter().any(|(existing, _)| *existing == name) {
            return Err(format!("Upload-Metadata has {name:?} twice"));
        }
        let value = STANDARD.decode(value.trim());
        let value = value.map_err(|_| format!("Upload-Metadata: {name:?} is not in base64"))?;
        pairs.push((name, value));
    }
    Ok(pairs)
}

/// A running checksum and its expected value.
#[derive(Debug)]
pub struct Checksum {
    hasher: Hasher,
    expected: Vec<u8>,
}

#[derive(Debug)]
enum Hasher {
    Sha1(sha1::Sha1),
    Sha256(sha2::Sha256),
}

impl Checksum {
    /// Parses an `Upload-Checksum`: the algorithm, a space, and the checksum in base64.
    pub fn parse(text: &str) -> Result<Self, String> {
        let form = || "Upload-Checksum must be sha1 or sha256, a space, and the checksum in base64";
        let (name, value) = text.split_once(' ').ok_or_else(form)?;
        let (hasher, length) = match name {
            "sha1" => (Hasher::Sha1(sha1::Sha1::new()), 20),
            "sha256" => (Hasher::Sha256(sha2::Sha256::new()), 32),
            _ => return Err(form().into()),
        };
        let expected = STANDARD.decode(value.trim()).map_err(|_| form())?;
        if expected.len() != length {
            return Err(format!("a {name} has {length} bytes, not {}", expected.len()));
        }
        Ok(Self { hasher, expected })
    }

    /// A SHA-256 with this expected value.
    pub fn sha256(expected: Sha256) -> Self {
        Self { hasher: Hasher::Sha256(sha2::Sha256::new()), expected: expected.bytes().to_vec() }
    }

    /// Adds bytes to the checksum.
    pub fn update(&mut self, bytes: &[u8]) {
        match &mut self.hasher {
            Hasher::Sha1(hasher) => hasher.update(bytes),
            Hasher::Sha256(hasher) => hasher.update(bytes),
        }
    }

    /// True if the checksum of all added bytes has the expected value.
    pub fn matches(self) -> bool {
        match self.hasher {
            Hasher::Sha1(hasher) => hasher.finalize()[..] == self.expected[..],
            Hasher::Sha256(hasher) => hasher.finalize()[..] == self.expected[..],
        }
    }
}

#[cfg(test)]
mod tests {
    use super::{Checksum, metadata};

    #[test]
    fn metadata_are_split_into_names_and_values() {
        let pairs = metadata("filename bWFza3MubnB5,flag, sha256  YWJj").unwrap();
        let masks = b"masks.npy".to_vec();
        assert_eq!(pairs, [("filename", masks), ("flag", vec![]), ("sha256", b"abc".to_vec())]);
        assert_eq!(metadata("").unwrap(), []);
        for bad in ["a a,a b", "a *", "a YWJj,a YWJj", &"x".repeat(5000)] {
            assert!(metadata(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn checksums_match_only_the_right_bytes() {
        for text in [
            "sha1 qZk+NkcGgWq6PiVxeFDCbJzQ2J0=",
            "sha256 ungWv48Bz+pBQUDeXa4iI7ADYaOWF3qctBD/YfIAFa0=",
        ] {
            let mut good = Checksum::parse(text).unwrap();
            good.update(b"a");
            good.update(b"bc");
            assert!(good.matches());
            let mut bad = Checksum::parse(text).unwrap();
            bad.update(b"abd");
            assert!(!bad.matches());
        }
        for bad in
            ["", "sha1", "md5 qZk=", "sha1 qZk=", "sha1 ***", "sha256 qZk+NkcGgWq6PiVxeFDCbJzQ2J0="]
        {
            assert!(Checksum::parse(bad).is_err(), "{bad}");
        }
    }
}
