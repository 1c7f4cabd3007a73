//! Failures to reach a service that persist until the user acts.

use std::error::Error;
use std::io;

use rustls::{CertificateError, Error as TlsError};

/// The remedy for a failure that retries can't solve: an untrusted certificate, a port without TLS, or an unknown
/// host. Returns `None` for all other failures.
pub(super) fn remedy(error: &(dyn Error + 'static)) -> Option<&'static str> {
    if let Some(error) = error.downcast_ref::<TlsError>() {
        return tls_remedy(error);
    }
    if let Some(error) = error.downcast_ref::<io::Error>() {
        if let Some(remedy) = lookup_remedy(error) {
            return Some(remedy);
        }
        if let Some(remedy) = error.get_ref().and_then(|inner| remedy(inner)) {
            return Some(remedy);
        }
    }
    error.source().and_then(remedy)
}

fn tls_remedy(error: &TlsError) -> Option<&'static str> {
    match error {
        TlsError::InvalidCertificate(error) => Some(certificate_remedy(error)),
        TlsError::InvalidMessage(_) => {
            Some("the server there does not use TLS; try http:// instead of https://")
        }
        TlsError::PeerIncompatible(_) => Some("the service supports neither TLS 1.2 nor TLS 1.3"),
        _ => None,
    }
}

fn certificate_remedy(error: &CertificateError) -> &'static str {
    match error {
        CertificateError::NotValidForName | CertificateError::NotValidForNameContext { .. } => {
            "the certificate of the service is for another host name; use that name in the address, or correct the \
             certificate"
        }
        CertificateError::Expired | CertificateError::ExpiredContext { .. } => {
            "the certificate of the service has expired; renew it, or correct the clock of this machine"
        }
        CertificateError::Other(reason) if reason.to_string().contains("CaUsedAsEndEntity") => {
            "the certificate of the service is that of an authority; create one for the service with the extension \
             basicConstraints=CA:FALSE"
        }
        _ => {
            "the certificate of the service is not trusted; give the certificate of its authority (PEM) in \
             SSL_CERT_FILE, or correct the certificate"
        }
    }
}

/// The remedy for an unknown host. The standard library reports the resolver's answer only as text.
fn lookup_remedy(error: &io::Error) -> Option<&'static str> {
    let text = error.to_string();
    let is_unknown =
        text.starts_with("failed to lookup address") && !text.contains("Temporary failure");
    is_unknown.then_some("correct the host name in the address")
}
