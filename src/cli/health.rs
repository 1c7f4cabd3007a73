//! `sci-recon health`: asks whether the service of a data folder is ready, for the health check of a container.

use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};
use std::path::PathBuf;
use std::time::Duration;

use clap::Args;

use super::CliError;
use super::output::print_line;
use super::serve::Announcement;
use super::wait::wait;
use crate::cli::error::Result;

/// Time that the service has to answer.
const PATIENCE: Duration = Duration::from_secs(4);

/// Ask the running service whether it is ready.
///
/// Ends with 1 if it is not.
#[derive(Debug, Args)]
pub struct Arguments {
    /// Folder of the service's data.
    #[arg(long, env = "SCI_RECON_DATA", value_name = "DIR")]
    data: PathBuf,
}

pub fn run(arguments: &Arguments) -> Result<()> {
    let announced = Announcement::read(&arguments.data).map_err(|error| {
        let data = arguments.data.display();
        CliError::Failure(format!("no service runs on this data folder ({data}): {error}"))
    })?;
    print_line(wait(ask(announced.address))?)
}

/// Returns the answer of `/readyz`.
async fn ask(address: SocketAddr) -> Result<String> {
    let broken = |error: reqwest::Error| CliError::Failure(format!("no answer: {error}"));
    let url = format!("http://{}/readyz", reachable(address));
    let client = crate::http_client().map_err(CliError::Failure)?.timeout(PATIENCE).no_proxy();
    let answer = client.build().map_err(broken)?.get(url).send().await.map_err(broken)?;
    let is_ready = answer.status().is_success();
    let text = answer.text().await.map_err(broken)?;
    if is_ready { Ok(text) } else { Err(CliError::Failure(text)) }
}

/// The address to connect to. A service that listens at all addresses is reached at the loopback address.
fn reachable(address: SocketAddr) -> SocketAddr {
    let ip = match address.ip() {
        IpAddr::V4(ip) if ip.is_unspecified() => Ipv4Addr::LOCALHOST.into(),
        IpAddr::V6(ip) if ip.is_unspecified() => Ipv6Addr::LOCALHOST.into(),
        ip => ip,
    };
    SocketAddr::new(ip, address.port())
}

#[cfg(test)]
mod tests {
    use super::reachable;

    #[test]
    fn a_service_at_all_addresses_is_reached_at_the_loopback_address() {
        for (listen, expected) in [
            ("0.0.0.0:80", "127.0.0.1:80"),
            ("[::]:80", "[::1]:80"),
            ("10.0.0.7:80", "10.0.0.7:80"),
        ] {
            assert_eq!(reachable(listen.parse().unwrap()), expected.parse().unwrap());
        }
    }
}
