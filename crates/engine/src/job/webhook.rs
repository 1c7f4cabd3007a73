//! Addresses that are notified when a job ends.

use std::str::FromStr;

use derive_more::Display;
use serde_with::{DeserializeFromStr, SerializeDisplay};
use url::Url;

use super::text::{InvalidText, text_schema};

/// An address that is notified when a job ends: `https:` or `http:` with a host, without user name and password.
#[derive(Debug, Clone, PartialEq, Eq, Display, SerializeDisplay, DeserializeFromStr)]
pub struct Webhook(Url);

impl Webhook {
    /// Longest address in characters.
    pub const MAX_CHARS: usize = 2000;

    pub fn as_str(&self) -> &str {
        self.0.as_str()
    }

    /// True if the administrator allows the host of the address: `allowed` are names, with a port unless it is the default
    /// one of the scheme.
    pub fn is_allowed(&self, allowed: &[String]) -> bool {
        let place = self.place();
        allowed.iter().any(|host| host.eq_ignore_ascii_case(&place))
    }

    /// Reads a host that the administrator allows, without a default port.
    ///
    /// Errors: the text is not a name or an address with an optional port.
    pub fn allowed_host(text: &str) -> Result<String, InvalidText> {
        let url = format!("https://{text}/").parse::<Self>().ok().filter(|hook| {
            let (url, has_star) = (&hook.0, text.contains('*'));
            url.path() == "/" && url.query().is_none() && !has_star
        });
        let host = url.map(|hook| hook.place()).ok_or_else(|| {
            InvalidText::new(format!(
                "{text:?} is not a host: give a name or an address with an optional port, such as lab.example or \
                 lab.example:8443"
            ))
        })?;
        Ok(host.strip_suffix(":80").map(str::to_owned).unwrap_or(host))
    }

    /// The host, with the port unless it is the default one of the scheme.
    pub fn place(&self) -> String {
        let host = self.0.host_str().unwrap_or_default();
        self.0.port().map_or(host.to_owned(), |port| format!("{host}:{port}"))
    }
}

impl FromStr for Webhook {
    type Err = InvalidText;

    fn from_str(text: &str) -> Result<Self, InvalidText> {
        let invalid = |reason: String| {
            InvalidText::new(format!(
                "the webhook {reason}: give an address such as https://lab.example/hooks/sci-recon"
            ))
        };
        if text.len() > Self::MAX_CHARS {
            return Err(invalid(format!("is longer than {} characters", Self::MAX_CHARS)));
        }
        let url = Url::parse(text).map_err(|error| invalid(format!("is no address ({error})")))?;
        if !matches!(url.scheme(), "http" | "https") || url.host().is_none() {
            return Err(invalid("does not begin with https:// or http:// and a host".into()));
        }
        if !url.username().is_empty() || url.password().is_some() || url.fragment().is_some() {
            return Err(invalid("has a user name, a password or a fragment".into()));
        }
        Ok(Self(url))
    }
}

text_schema!(Webhook, "Webhook", {
    "type": "string",
    "format": "uri",
    "description": "Address that is notified when the job ends. The administrator allows its host.",
    "maxLength": Self::MAX_CHARS,
    "pattern": "^https?://",
    "example": "https://lab.example/hooks/sci-recon",
});

#[cfg(test)]
mod tests {
    use super::Webhook;

    #[test]
    fn only_addresses_of_hosts_are_accepted() {
        let hook = |text: &str| text.parse::<Webhook>();
        for text in ["", "lab.example/hook", "ftp://lab.example/", "file:///etc/passwd", "https://"]
        {
            assert!(hook(text).is_err(), "{text}");
        }
        for text in ["https://me:secret@lab.example/", "https://me@lab.example/", "http://a/#b"] {
            assert!(hook(text).unwrap_err().to_string().contains("user name"), "{text}");
        }
        let long = format!("https://lab.example/{}", "a".repeat(Webhook::MAX_CHARS));
        assert!(hook(&long).unwrap_err().to_string().contains("2000 characters"));
    }

    #[test]
    fn an_allowed_host_is_a_host_with_an_optional_port() {
        for (text, host) in [
            ("lab.example", "lab.example"),
            ("Lab.example:443", "lab.example"),
            ("[::1]:9000", "[::1]:9000"),
        ] {
            assert_eq!(Webhook::allowed_host(text).unwrap(), host);
        }
        for text in [
            "",
            "https://lab.example/",
            "lab.example/x",
            "me@lab.example",
            "*.example",
            "a:99999",
            "[::1",
            "a?b",
        ] {
            assert!(
                Webhook::allowed_host(text).unwrap_err().to_string().contains("is not a host"),
                "{text}"
            );
        }
    }

    #[test]
    fn a_host_is_allowed_with_its_port_alone() {
        let allowed = ["Lab.example".to_owned(), "127.0.0.1:9000".to_owned()];
        let is_allowed = |text: &str| text.parse::<Webhook>().unwrap().is_allowed(&allowed);
        assert!(is_allowed("https://lab.example/hook") && is_allowed("http://LAB.example:80/"));
        assert!(is_allowed("http://127.0.0.1:9000/x"));
        assert!(!is_allowed("https://lab.example:8443/") && !is_allowed("http://127.0.0.1/"));
        assert!(!is_allowed("https://lab.example.evil/") && !is_allowed("http://2130706433:9001/"));
    }
}
