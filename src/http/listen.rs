//! The connections: how many there may be, how long they may be silent, and how slow.

use std::collections::HashMap;
use std::convert::Infallible;
use std::net::IpAddr;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use axum::Router;
use axum::response::Response;
use hyper::Request;
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::server::graceful::GracefulShutdown;
use hyper_util::service::TowerToHyperService;
use rustix::process::{Resource, getrlimit, setrlimit};
use socket2::SockRef;
use tokio::net::{TcpListener, TcpStream};
use tower::ServiceExt;

use super::write_deadline::{LeastRate, WriteDeadline};
use crate::config::ServeArguments;

/// A connection that sends no whole head of a request for so long is closed, the first one and between
/// two requests.
const SILENCE: Duration = Duration::from_secs(30);
/// Connections of one address, such as that of a proxy or of a lab behind one; more are closed at once.
const MOST_OF_AN_ADDRESS: usize = 2048;
/// Unsent bytes of a connection that the kernel takes from us. With megabytes, as is the kernel's default, it would take
/// nothing for minutes from a connection with a slow client, as from one that stands still.
const UNSENT_BYTES: u32 = 64 * 1024;
/// Files that are kept for what is no connection.
const OTHER_FILES: u64 = 256;

/// Answers at all connections, until `stop`; then lets requests that have begun come to their end.
pub async fn listen(
    listener: TcpListener,
    router: Router,
    settings: &ServeArguments,
    stop: impl Future<Output = ()>,
) {
    let (rate, time) = (settings.download_bytes_per_second, settings.download_stall());
    let least = LeastRate { bytes: rate.saturating_mul(time.as_secs()), time };
    let places = Places::new(raise_file_limit());
    let service = ServiceExt::<Request<Incoming>>::map_result(router, cut);
    let service = TowerToHyperService::new(service);
    let mut http = http1::Builder::new();
    http.timer(TokioTimer::new()).header_read_timeout(SILENCE);
    let graceful = GracefulShutdown::new();
    tokio::pin!(stop);
    loop {
        let accepted = tokio::select! {
            accepted = listener.accept() => accepted,
            () = &mut stop => break,
        };
        let (stream, address) = match accepted {
            Ok(accepted) => accepted,
            Err(error) => {
                // One that was gone at once, or no file is free: others may end meanwhile.
                tracing::warn!(%error, "a connection was not accepted");
                tokio::time::sleep(Duration::from_millis(50)).await;
                continue;
            }
        };
        let Some(place) = places.take(address.ip()) else {
            tracing::warn!(%address, "too many connections");
            continue;
        };
        let connection = graceful.watch(http.serve_connection(io(stream, least), service.clone()));
        tokio::spawn(async move {
            if let Err(error) = connection.await {
                tracing::debug!(%error, "a connection broke");
            }
            drop(place);
        });
    }
    drop(listener);
    graceful.shutdown().await;
}

/// Marks an answer whose connection ends in place of it.
#[derive(Debug, Clone, Copy, thiserror::Error)]
#[error("the connection is closed without an answer")]
pub(super) struct Cut;

impl From<Infallible> for Cut {
    fn from(never: Infallible) -> Self {
        match never {}
    }
}

/// An error makes hyper close the connection.
fn cut(answer: Result<Response, Infallible>) -> Result<Response, Cut> {
    let Ok(response) = answer;
    match response.extensions().get::<Cut>() {
        Some(cut) => Err(*cut),
        None => Ok(response),
    }
}

fn io(stream: TcpStream, least: LeastRate) -> TokioIo<WriteDeadline<TcpStream>> {
    // Small answers go at once; a stream for which that can't be had works as well.
    let _ = stream.set_nodelay(true);
    // Without it, slow clients are broken off that are faster than they need to be.
    let _ = SockRef::from(&stream).set_tcp_notsent_lowat(UNSENT_BYTES);
    TokioIo::new(WriteDeadline::new(stream, least))
}

/// Allows as many open files as the system does, and says how many those are.
fn raise_file_limit() -> u64 {
    let mut limit = getrlimit(Resource::Nofile);
    limit.current = limit.maximum;
    if let Err(error) = setrlimit(Resource::Nofile, limit) {
        tracing::warn!(%error, "the limit on open files stays as it is");
    }
    getrlimit(Resource::Nofile).current.unwrap_or(u64::MAX)
}

/// The connections there are.
#[derive(Debug, Clone)]
struct Places {
    most: usize,
    taken: Arc<Mutex<HashMap<IpAddr, usize>>>,
}

/// A connection among them, until it is dropped.
#[derive(Debug)]
struct Place {
    places: Places,
    address: IpAddr,
}

impl Places {
    fn new(files: u64) -> Self {
        let most = files.saturating_sub(OTHER_FILES).max(1);
        Self { most: usize::try_from(most).unwrap_or(usize::MAX), taken: Arc::default() }
    }

    fn take(&self, address: IpAddr) -> Option<Place> {
        let mut taken = self.taken.lock().unwrap_or_else(PoisonError::into_inner);
        let all: usize = taken.values().sum();
        // Who is refused leaves no entry behind.
        let own = taken.get(&address).copied().unwrap_or(0);
        if all >= self.most || own >= MOST_OF_AN_ADDRESS {
            return None;
        }
        taken.insert(address, own + 1);
        Some(Place { places: self.clone(), address })
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let mut taken = self.places.taken.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(own) = taken.get_mut(&self.address) {
            *own -= 1;
            if *own == 0 {
                taken.remove(&self.address);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::{MOST_OF_AN_ADDRESS, OTHER_FILES, Places};

    #[test]
    fn one_address_leaves_places_for_others() {
        let places = Places::new(1 << 20);
        let (one, other) = ("10.0.0.1".parse().unwrap(), "10.0.0.2".parse().unwrap());
        let mut held: Vec<_> = (0..MOST_OF_AN_ADDRESS).map(|_| places.take(one).unwrap()).collect();
        assert!(places.take(one).is_none());
        assert!(places.take(other).is_some());
        held.pop();
        assert!(places.take(one).is_some());
    }

    #[test]
    fn connections_leave_files_for_the_rest() {
        let places = Places::new(OTHER_FILES + 2);
        let address = "10.0.0.1".parse().unwrap();
        let held = (places.take(address), places.take(address));
        assert!(held.0.is_some() && held.1.is_some() && places.take(address).is_none());
        assert!(places.take("10.0.0.2".parse().unwrap()).is_none());
        drop(held);
        assert!(places.taken.lock().unwrap().is_empty());
    }
}
