//! The service, which lab machines use over HTTP, and the commands of the program.

pub mod audit;
pub mod cli;
pub mod config;
pub mod http;
#[cfg(feature = "otel")]
mod traces;
mod webhooks;

/// A builder of HTTP clients that trust the certificates of the system, or those of `SSL_CERT_FILE` and `SSL_CERT_DIR`.
///
/// A system without certificates is no error: addresses with `http://` need none.
///
/// # Errors
/// One of the variables is set, but there is no certificate in its place.
pub fn http_client() -> Result<reqwest::ClientBuilder, String> {
    let found = rustls_native_certs::load_native_certs();
    let file = std::env::var_os("SSL_CERT_FILE").filter(|file| !file.is_empty());
    let is_lost = file.is_some_and(|file| !std::path::Path::new(&file).is_file());
    let stated = ["SSL_CERT_FILE", "SSL_CERT_DIR"].into_iter().find_map(|variable| {
        let place = std::env::var_os(variable).filter(|place| !place.is_empty())?;
        Some(format!("{variable} names {}, which has no certificate in PEM form", place.display()))
    });
    if let Some(stated) = stated.filter(|_| is_lost || found.certs.is_empty()) {
        return Err(format!("{stated}: correct the variable, or unset it"));
    }
    let mut trusted = rustls::RootCertStore::empty();
    trusted.add_parsable_certificates(found.certs);
    let tls = rustls::ClientConfig::builder().with_root_certificates(trusted).with_no_client_auth();
    Ok(reqwest::Client::builder().tls_backend_preconfigured(tls))
}
