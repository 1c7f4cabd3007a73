//! The service, which lab machines use over HTTP, and the commands of the program.

pub mod audit;
pub mod cli;
pub mod config;
pub mod http;
mod webhooks;

/// A builder of HTTP clients that trust the certificates of the system, or those of `SSL_CERT_FILE`.
///
/// A system without certificates is no error: addresses with `http://` need none.
pub fn http_client() -> reqwest::ClientBuilder {
    let mut trusted = rustls::RootCertStore::empty();
    trusted.add_parsable_certificates(rustls_native_certs::load_native_certs().certs);
    let tls = rustls::ClientConfig::builder().with_root_certificates(trusted).with_no_client_auth();
    reqwest::Client::builder().tls_backend_preconfigured(tls)
}
