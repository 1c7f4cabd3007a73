//! The service, which lab machines use over HTTP, and the commands of the program.

pub mod audit;
pub mod cli;
pub mod config;
pub mod http;
#[cfg(feature = "otel")]
mod traces;
mod webhooks;

use std::path::{Path, PathBuf};

/// A builder of HTTP clients that trust the certificates of the system, or those of `SSL_CERT_FILE` and `SSL_CERT_DIR`.
///
/// A system without certificates is no error: addresses with `http://` need none.
///
/// # Errors
/// One of the variables is set, but its place can't be read or has no certificate.
pub fn http_client() -> Result<reqwest::ClientBuilder, String> {
    let stated =
        |variable| std::env::var_os(variable).filter(|place| !place.is_empty()).map(PathBuf::from);
    let refused = |variable: &str, place: &Path, problem: &str| {
        format!(
            "{variable} names {}, which {problem}: correct the variable, or unset it",
            place.display()
        )
    };
    let none = "has no certificate in PEM form";
    if let Some(file) = &stated("SSL_CERT_FILE") {
        let bytes = std::fs::read(file)
            .map_err(|error| refused("SSL_CERT_FILE", file, &format!("can't be read ({error})")))?;
        let begin = b"-----BEGIN CERTIFICATE-----";
        if !bytes.windows(begin.len()).any(|text| text == begin) {
            return Err(refused("SSL_CERT_FILE", file, none));
        }
    }
    let found = rustls_native_certs::load_native_certs();
    if let Some(folder) = stated("SSL_CERT_DIR").filter(|_| found.certs.is_empty()) {
        return Err(refused("SSL_CERT_DIR", &folder, none));
    }
    let mut trusted = rustls::RootCertStore::empty();
    trusted.add_parsable_certificates(found.certs);
    let tls = rustls::ClientConfig::builder().with_root_certificates(trusted).with_no_client_auth();
    Ok(reqwest::Client::builder().tls_backend_preconfigured(tls))
}
