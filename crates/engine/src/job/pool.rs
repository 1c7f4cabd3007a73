//! Pools of workers on other machines.

use std::str::FromStr;

use derive_more::Display;
use serde_with::{DeserializeFromStr, SerializeDisplay};

use super::text::{InvalidText, plain_name};

/// The name of a worker pool. All workers of a pool have the same rights and receive the same kind of tiles.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[derive(Display, SerializeDisplay, DeserializeFromStr)]
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

impl FromStr for Pool {
    type Err = InvalidText;

    fn from_str(text: &str) -> Result<Self, InvalidText> {
        plain_name(text, "pool", Self::MAX_LENGTH).map(Self)
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
