//! Connections and requests of each client address, so that no client takes all of them.

use std::collections::HashMap;
use std::net::IpAddr;
use std::pin::Pin;
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll};
use std::time::Instant;

use axum::body::{Body, Bytes, HttpBody};
use axum::extract::{Request, State};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use hyper::body::{Frame, SizeHint};

use super::client::Client;
use super::error::{ApiError, Code};
use super::turnover::Turnover;

/// Places of one address at most, also if there are very many.
const MOST_OF_AN_ADDRESS: usize = 2048;

/// Places for connections, or for requests through proxies. An address has at most half of them.
#[derive(Debug, Clone)]
pub(super) struct Places {
    most: usize,
    per_address: usize,
    taken: Arc<Mutex<Taken>>,
}

#[derive(Debug, Default)]
struct Taken {
    by_network: HashMap<IpAddr, usize>,
    turnover: Turnover,
}

/// A place, until it is dropped.
#[derive(Debug)]
pub(super) struct Place {
    places: Places,
    network: IpAddr,
    since: Instant,
}

impl Places {
    pub(super) fn new(most: usize) -> Self {
        let per_address = most.div_ceil(2).min(MOST_OF_AN_ADDRESS);
        Self { most, per_address, taken: Arc::default() }
    }

    /// A place for this address; `None` if it has its share, or all are taken.
    pub(super) fn take(&self, address: IpAddr) -> Option<Place> {
        self.take_within(address, self.per_address)
    }

    /// A place for the address of a proxy, which may have all of them.
    pub(super) fn take_any(&self, address: IpAddr) -> Option<Place> {
        self.take_within(address, usize::MAX)
    }

    /// Estimated seconds until a place of this address is free.
    fn next_end(&self, address: IpAddr) -> u64 {
        let taken = self.taken.lock().unwrap_or_else(PoisonError::into_inner);
        let held = taken.by_network.get(&Client::network(address)).copied().unwrap_or(0);
        taken.turnover.next_end(held)
    }

    fn take_within(&self, address: IpAddr, limit: usize) -> Option<Place> {
        let network = Client::network(address);
        let mut taken = self.taken.lock().unwrap_or_else(PoisonError::into_inner);
        let all: usize = taken.by_network.values().sum();
        let own = taken.by_network.get(&network).copied().unwrap_or(0);
        if all >= self.most || own >= limit {
            return None;
        }
        taken.by_network.insert(network, own + 1);
        Some(Place { places: self.clone(), network, since: Instant::now() })
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let mut taken = self.places.taken.lock().unwrap_or_else(PoisonError::into_inner);
        taken.turnover.record(self.since.elapsed());
        if let Some(own) = taken.by_network.get_mut(&self.network) {
            *own -= 1;
            if *own == 0 {
                taken.by_network.remove(&self.network);
            }
        }
    }
}

/// Refuses a request through a proxy if its client has enough of them in progress. Other clients are limited by their
/// connections.
pub(super) async fn limit(State(places): State<Places>, request: Request, next: Next) -> Response {
    let client = request.extensions().get::<Client>().filter(|client| client.is_forwarded).copied();
    let Some(client) = client else { return next.run(request).await };
    let Some(place) = places.take(client.address) else {
        let detail = format!(
            "{} has {} requests in progress; wait for the end of some",
            client.address, places.per_address
        );
        let seconds = places.next_end(client.address);
        return ApiError::new(Code::RateLimited, detail).retry_after(seconds).into_response();
    };
    next.run(request).await.map(|body| Body::new(Held { body, _place: place }))
}

/// A body that keeps a place until it is sent.
struct Held {
    body: Body,
    _place: Place,
}

impl HttpBody for Held {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, axum::Error>>> {
        Pin::new(&mut self.body).poll_frame(context)
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}

#[cfg(test)]
mod tests {
    use super::{MOST_OF_AN_ADDRESS, Places};

    #[test]
    fn an_address_leaves_places_for_others() {
        for (most, share) in [(1 << 20, MOST_OF_AN_ADDRESS), (44, 22), (1, 1)] {
            let places = Places::new(most);
            let (one, other) = ("10.0.0.1".parse().unwrap(), "10.0.0.2".parse().unwrap());
            let mut held: Vec<_> = (0..share).map(|_| places.take(one).unwrap()).collect();
            assert!(places.take(one).is_none());
            assert_eq!(places.take(other).is_some(), most > 1);
            held.pop();
            assert!(places.take(one).is_some());
            drop(held);
            assert!(places.taken.lock().unwrap().by_network.is_empty());
        }
    }

    #[test]
    fn a_proxy_may_have_all_places_but_a_network_of_ipv6_only_half() {
        let places = Places::new(4);
        let proxy = "10.0.0.1".parse().unwrap();
        let held: Vec<_> = (0..4).map(|_| places.take_any(proxy)).collect();
        assert!(held.iter().all(Option::is_some) && places.take_any(proxy).is_none());
        drop(held);
        let held = ["2001:db8::1", "2001:db8::2"].map(|text| places.take(text.parse().unwrap()));
        assert!(held.iter().all(Option::is_some));
        assert!(places.take("2001:db8::3".parse().unwrap()).is_none());
        assert!(places.take("2001:db8:0:1::1".parse().unwrap()).is_some());
    }
}
