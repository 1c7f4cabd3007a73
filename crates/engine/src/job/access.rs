//! Access control: labs, roles and tokens.

use std::fmt;
use std::str::FromStr;

use rand::TryRng;
use rand::rngs::{SysError, SysRng};

use serde::Serialize;
use strum::{Display, EnumString, IntoStaticStr, VariantArray};

use super::text::{InvalidText, Sha256, plain_name};

/// A lab (tenant). Data belong to one lab and are invisible to all others.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Serialize, derive_more::Display, schemars::JsonSchema)]
#[serde(transparent)]
#[schemars(rename = "LabName")]
pub struct Lab(String);

impl Lab {
    /// The lab of a service that runs without tokens.
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
        plain_name(text, "lab", 40).map(Self)
    }
}

/// The permissions of a token. Each role includes those before it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
#[derive(Serialize, Display, EnumString, IntoStaticStr, VariantArray, schemars::JsonSchema)]
#[serde(rename_all = "snake_case")]
#[strum(serialize_all = "snake_case", const_into_str)]
#[strum(parse_err_ty = InvalidText, parse_err_fn = unknown_role)]
pub enum Role {
    /// View the lab's data and download results.
    Read,
    /// Upload data, submit and cancel jobs, delete.
    Submit,
    /// View metrics and the state of the service, and give jobs a priority above 0.
    Admin,
}

fn unknown_role(text: &str) -> InvalidText {
    InvalidText::new(format!("{text:?} is not a role: use read, submit or admin"))
}

/// The secret of a token or a session. `Debug` does not print it.
#[derive(Clone, PartialEq, Eq, Hash)]
pub struct Secret(String);

/// Prefix of all tokens, so that leaked ones can be recognised, for example by secret scanners.
const PREFIX: &str = "sci_";

impl Secret {
    /// Generates a new secret.
    ///
    /// Errors: the operating system provides no random numbers.
    pub fn random() -> Result<Self, SysError> {
        let mut bytes = [0; 32];
        SysRng.try_fill_bytes(&mut bytes)?;
        Ok(Self::from_bytes(bytes))
    }

    /// The secret with these 256 bits.
    fn from_bytes(bytes: [u8; 32]) -> Self {
        Self(format!("{PREFIX}{}", Sha256::new(bytes)))
    }

    /// Parses a secret; `None` if the text is malformed.
    pub fn parse(text: &str) -> Option<Self> {
        text.strip_prefix(PREFIX)?.parse::<Sha256>().ok()?;
        Some(Self(text.into()))
    }

    /// The hash that is stored instead of the secret. A plain hash suffices because the secret is random.
    pub fn hash(&self) -> Sha256 {
        Sha256::of(self.0.as_bytes())
    }

    /// The secret itself, to be shown once to its owner.
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
    fn lab_names_are_lower_case_identifiers() {
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
    fn secrets_are_parsed_but_not_printed() {
        let secret = Secret::from_bytes([7; 32]);
        assert_eq!(Secret::parse(secret.reveal()).unwrap(), secret);
        assert!(!format!("{secret:?}").contains("0707"));
        for bad in ["", "sci_", "sci_xyz", &secret.reveal()[4..]] {
            assert_eq!(Secret::parse(bad), None, "{bad}");
        }
    }
}
