//! Failures to reach a service that no further try mends.

use std::error::Error;
use std::io;

use rustls::Error as TlsError;

/// What to do about a failed connection, if trying again can't help: a certificate that is not trusted, a server that
/// does not speak TLS, a host that does not exist.
pub(super) fn remedy(error: &(dyn Error + 'static)) -> Option<&'static str> {
    if let Some(error) = error.downcast_ref::<TlsError>() {
        return of_tls(error);
    }
    if let Some(error) = error.downcast_ref::<io::Error>() {
        if let Some(remedy) = of_lookup(error) {
            return Some(remedy);
        }
        if let Some(remedy) = error.get_ref().and_then(|inner| remedy(inner)) {
            return Some(remedy);
        }
    }
    error.source().and_then(remedy)
}

fn of_tls(error: &TlsError) -> Option<&'static str> {
    match error {
        TlsError::InvalidCertificate(_) => Some(
            "the certificate of the service is not trusted; name the certificate of its authority (PEM) in \
             SSL_CERT_FILE, or correct the certificate",
        ),
        TlsError::InvalidMessage(_) => {
            Some("nothing there speaks TLS; is it http:// instead of https://?")
        }
        TlsError::PeerIncompatible(_) => Some("the service speaks no version of TLS from 1.2 on"),
        _ => None,
    }
}

/// The standard library gives the resolver's answer as text only.
fn of_lookup(error: &io::Error) -> Option<&'static str> {
    let text = error.to_string();
    let unknown =
        text.starts_with("failed to lookup address") && !text.contains("Temporary failure");
    unknown.then_some("correct the host name in the address")
}
