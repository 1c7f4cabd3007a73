//! Who may do what: labs, roles and tokens.

use std::fmt;
use std::str::FromStr;

use rand::TryRngCore;
use rand::rand_core::OsError;
use rand::rngs::OsRng;
use serde::Serialize;
use strum::{Display, EnumString, IntoStaticStr, VariantArray};

use super::text::{InvalidText, Sha256};

/// A lab, to which data belong: no lab sees another one's.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Serialize, derive_more::Display)]
#[serde(transparent)]
pub struct Lab(String);

impl Lab {
    /// The lab of all who use a service without tokens.
    pub fn local() -> Self {
        Self("local".into())
    }

    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl FromStr for Lab {
    type Err = InvalidText;

    fn from_str(text: &str) -> Result<Self, InvalidText> {
        let plain = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '-';
        if (1..=40).contains(&text.len()) && text.chars().all(plain) {
            return Ok(Self(text.into()));
        }
        Err(InvalidText::new(format!(
            "{text:?} can't be the name of a lab; it has 1 to 40 of a-z, 0-9 and -"
        )))
    }
}

/// What a token is good for. Each role may do what those before it may.
#[derive(
    Debug,
    Clone,
    Copy,
    PartialEq,
    Eq,
    PartialOrd,
    Ord,
    Serialize,
    Display,
    EnumString,
    IntoStaticStr,
    VariantArray,
)]
#[serde(rename_all = "snake_case")]
#[strum(serialize_all = "snake_case", const_into_str)]
#[strum(parse_err_ty = InvalidText, parse_err_fn = no_role)]
pub enum Role {
    /// Look at the lab's data and download results.
    Read,
    /// Upload, ask for jobs, cancel and delete.
    Submit,
    /// See the figures of the whole service, too.
    Admin,
}

/// Says which roles there are.
fn no_role(text: &str) -> InvalidText {
    InvalidText::new(format!("{text:?} is not a role; roles are read, submit and admin"))
}

/// A token or session as its holder has it. It shows itself to nobody who only prints it for debugging.
#[derive(Clone, PartialEq, Eq, Hash)]
pub struct Secret(String);

/// With this, a token that was left lying about is known for what it is.
const PREFIX: &str = "sci_";

impl Secret {
    /// A new one.
    /// Errors: if the system gives no random numbers.
    pub fn random() -> Result<Self, OsError> {
        let mut bytes = [0; 32];
        OsRng.try_fill_bytes(&mut bytes)?;
        Ok(Self::from_bytes(bytes))
    }

    /// The token of 256 random bits.
    fn from_bytes(bytes: [u8; 32]) -> Self {
        Self(format!("{PREFIX}{}", Sha256::new(bytes)))
    }

    /// The text, if it has the form of a token.
    pub fn parse(text: &str) -> Option<Self> {
        text.strip_prefix(PREFIX)?.parse::<Sha256>().ok()?;
        Some(Self(text.into()))
    }

    /// What is stored instead of the token. Its bits are random, so a plain hash keeps it.
    pub fn hash(&self) -> Sha256 {
        Sha256::of(self.0.as_bytes())
    }

    /// The token itself, to be shown once to the one it is made for.
    pub fn reveal(&self) -> &str {
        &self.0
    }
}

impl fmt::Debug for Secret {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Secret(..)")
    }
}

#[cfg(test)]
mod tests {
    use strum::VariantArray;

    use super::{Lab, Role, Secret};

    #[test]
    fn labs_have_plain_names() {
        assert!("optics-2".parse::<Lab>().is_ok());
        for bad in ["", "a b", "A", "a/b", "..", "\u{e9}", &"x".repeat(41)] {
            assert!(bad.parse::<Lab>().is_err(), "{bad}");
        }
    }

    #[test]
    fn roles_are_ordered_and_named() {
        assert!(Role::Read < Role::Submit && Role::Submit < Role::Admin);
        for role in Role::VARIANTS {
            assert_eq!(role.into_str().parse::<Role>().unwrap(), *role);
        }
    }

    #[test]
    fn a_secret_is_parsed_but_not_printed() {
        let secret = Secret::from_bytes([7; 32]);
        assert_eq!(Secret::parse(secret.reveal()).unwrap(), secret);
        assert!(!format!("{secret:?}").contains("0707"));
        for bad in ["", "sci_", "sci_xyz", &secret.reveal()[4..]] {
            assert_eq!(Secret::parse(bad), None, "{bad}");
        }
    }
}
