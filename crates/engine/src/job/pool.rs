//! Pools of workers on other machines.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

/// The name of a pool: those of its workers have the same rights and get the same tiles.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Pool(String);

impl Pool {
    /// The longest name.
    pub const MAX_LENGTH: usize = 32;

    /// The name.
    #[must_use]
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

/// The text is no name of a pool.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "{0:?} is no name of a pool: it should have 1 to {max} characters of a to z, 0 to 9 and -",
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
    fn a_pool_has_a_name_that_can_stand_in_a_subject() {
        for good in ["gpu", "lab-2", "0"] {
            assert_eq!(good.parse::<Pool>().unwrap().as_str(), good);
        }
        for bad in ["", "GPU", "a.b", "*", ">", "a b", &"a".repeat(33)] {
            assert!(bad.parse::<Pool>().is_err(), "{bad}");
        }
    }
}
