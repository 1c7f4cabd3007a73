//! The connections: how many there may be, how long they may be silent, and how slow.

use std::convert::Infallible;
use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::response::Response;
use hyper::Request;
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::server::graceful::GracefulShutdown;
use ipnet::IpNet;
use rustix::process::{Resource, getrlimit, setrlimit};
use socket2::SockRef;
use tokio::net::{TcpListener, TcpStream};
use tower::ServiceExt;

use super::client::Client;
use super::shares::Places;
use super::throttle::Throttle;
use super::write_deadline::{LeastRate, WriteDeadline};
use crate::config::ServeArguments;

/// A connection that sends no whole head of a request for so long is closed, the first one and between
/// two requests.
const SILENCE: Duration = Duration::from_secs(30);
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
    let places = Places::for_clients(connection_limit());
    let proxies: Arc<[IpNet]> = settings.trusted_proxies.as_slice().into();
    let refusals = Throttle::default();
    let service = ServiceExt::<Request<Incoming>>::map_result(router, cut);
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
        let peer = address.ip();
        let is_proxy = proxies.iter().any(|net| net.contains(&peer.to_canonical()));
        // The connections of a proxy serve many clients, so requests are counted instead.
        let share = if is_proxy { places.most } else { places.share };
        let Ok(place) = places.take_within(&Client::network(peer), share) else {
            refusals.pass(
                || tracing::warn!(%address, "too many connections"),
                |left_out| tracing::warn!(left_out, "too many connections"),
            );
            continue;
        };
        let (service, proxies) = (service.clone(), proxies.clone());
        let with_client = service_fn(move |mut request: Request<Incoming>| {
            let client = Client::of(peer, request.headers(), &proxies);
            request.extensions_mut().insert(client);
            service.clone().oneshot(request)
        });
        let connection = graceful.watch(http.serve_connection(io(stream, least), with_client));
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

/// The number of connections that the limit on open files allows.
pub(super) fn connection_limit() -> usize {
    let most = raise_file_limit().saturating_sub(OTHER_FILES).max(1);
    usize::try_from(most).unwrap_or(usize::MAX)
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
