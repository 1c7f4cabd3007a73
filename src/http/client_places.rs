//! Connections and requests of each client address, so that no client takes all of them.

use std::net::IpAddr;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};

use axum::body::{Body, Bytes, HttpBody};
use axum::extract::{Request, State};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use hyper::body::{Frame, SizeHint};

use super::client::Client;
use super::error::{ApiError, Code};
use super::shares::{Place, Places};

/// Places of one address at most, also if there are very many.
const MOST_OF_AN_ADDRESS: usize = 2048;

impl Places<IpAddr> {
    /// Places for connections, or for requests through proxies. An address has at most half of them.
    pub(super) fn for_clients(most: usize) -> Self {
        let share = most.div_ceil(2).min(MOST_OF_AN_ADDRESS);
        Self { most, share, always_one: false, taken: Arc::default() }
    }
}

/// Refuses a request through a proxy if its client has enough of them in progress. Other clients are limited by their
/// connections.
pub(super) async fn limit(
    State(places): State<Places<IpAddr>>,
    request: Request,
    next: Next,
) -> Response {
    let client = request.extensions().get::<Client>().filter(|client| client.is_forwarded).copied();
    let Some(client) = client else { return next.run(request).await };
    let place = match places.take(&Client::network(client.address)) {
        Ok(place) => place,
        Err(full) => {
            let detail = format!(
                "{} has {} requests in progress; wait for the end of some",
                client.address, places.share
            );
            let refused = ApiError::new(Code::RateLimited, detail);
            return refused.retry_after(full.seconds).into_response();
        }
    };
    next.run(request).await.map(|body| Body::new(PlacedBody { body, _place: place }))
}

/// A body that keeps a place until it is sent.
struct PlacedBody {
    body: Body,
    _place: Place<IpAddr>,
}

impl HttpBody for PlacedBody {
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
    use super::{Client, IpAddr, MOST_OF_AN_ADDRESS, Places};

    fn network(address: &str) -> IpAddr {
        Client::network(address.parse().unwrap())
    }

    #[test]
    fn an_address_leaves_places_for_others() {
        for (most, share) in [(1 << 20, MOST_OF_AN_ADDRESS), (44, 22), (1, 1)] {
            let places = Places::for_clients(most);
            let (one, other) = (network("10.0.0.1"), network("10.0.0.2"));
            let mut held: Vec<_> = (0..share).map(|_| places.take(&one).unwrap()).collect();
            assert!(places.take(&one).is_err());
            assert_eq!(places.take(&other).is_ok(), most > 1);
            held.pop();
            assert!(places.take(&one).is_ok());
            drop(held);
            assert!(places.taken.lock().unwrap().by_holder.is_empty());
        }
    }

    #[test]
    fn a_proxy_may_have_all_places_but_a_network_of_ipv6_only_half() {
        let places = Places::for_clients(4);
        let proxy = network("10.0.0.1");
        let held: Vec<_> = (0..4).map(|_| places.take_within(&proxy, places.most)).collect();
        assert!(held.iter().all(Result::is_ok) && places.take_within(&proxy, places.most).is_err());
        drop(held);
        let held = ["2001:db8::1", "2001:db8::2"].map(|text| places.take(&network(text)));
        assert!(held.iter().all(Result::is_ok));
        assert!(places.take(&network("2001:db8::3")).is_err());
        assert!(places.take(&network("2001:db8:0:1::1")).is_ok());
    }
}
