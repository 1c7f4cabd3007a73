//! Pools of workers on other machines.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

/// The name of a worker pool. All workers of a pool have the same rights and receive the same kind of tiles.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Pool(String);

impl Pool {
    /// Longest name in characters.
    pub const MAX_LENGTH: usize = 32;

    /// The name as text.
    #[must_use]
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

/// A text is not a valid pool name.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "{0:?} is not a valid pool name: use 1 to {max} characters of a-z, 0-9 and -",
    max = Pool::MAX_LENGTH
)]
pub struct InvalidPool(String);

impl FromStr for Pool {
    type Err = InvalidPool;

    fn from_str(text: &str) -> Result<Self, InvalidPool> {
        let is_good = |byte: u8| byte.is_ascii_lowercase() || byte.is_ascii_digit() || byte == b'-';
        if (1..=Self::MAX_LENGTH).contains(&text.len()) && text.bytes().all(is_good) {
            return Ok(Self(text.to_owned()));
        }
        Err(InvalidPool(text.chars().take(60).collect()))
    }
}

impl TryFrom<String> for Pool {
    type Error = InvalidPool;

    fn try_from(text: String) -> Result<Self, InvalidPool> {
        text.parse()
    }
}

impl From<Pool> for String {
    fn from(pool: Pool) -> String {
        pool.0
    }
}

impl fmt::Display for Pool {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

#[cfg(test)]
mod tests {
    use super::Pool;

    #[test]
    fn pool_names_are_valid_nats_subject_tokens() {
        for good in ["gpu", "lab-2", "0"] {
            assert_eq!(good.parse::<Pool>().unwrap().as_str(), good);
        }
        for bad in ["", "GPU", "a.b", "*", ">", "a b", &"a".repeat(33)] {
            assert!(bad.parse::<Pool>().is_err(), "{bad}");
        }
    }
}
