//! The address of a client, through trusted proxies.

use std::net::{IpAddr, Ipv6Addr, SocketAddr};

use axum::http::HeaderMap;
use ipnet::IpNet;

/// The sender of a request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Client {
    pub(super) address: IpAddr,
    /// True if a trusted proxy forwarded the request.
    pub(super) is_forwarded: bool,
    /// True if a trusted proxy states that the client uses HTTPS.
    pub(super) is_https: bool,
}

/// A proxy between the client and the service, as its headers describe it.
struct Hop {
    address: Option<IpAddr>,
    is_https: bool,
}

impl Client {
    /// The client of a request that came from `peer`. Only trusted proxies may name another one, in `X-Forwarded-For`
    /// or, without that header, in `Forwarded` (RFC 7239). The last address that is not a trusted proxy counts, because
    /// a client can send these headers as well.
    pub(super) fn of(peer: IpAddr, headers: &HeaderMap, proxies: &[IpNet]) -> Self {
        let peer = peer.to_canonical();
        let is_trusted = |address: &IpAddr| proxies.iter().any(|net| net.contains(address));
        let mut client = Self { address: peer, is_forwarded: false, is_https: false };
        if !is_trusted(&peer) {
            return client;
        }
        for hop in hops(headers).into_iter().rev() {
            let Some(address) = hop.address.filter(|_| is_trusted(&client.address)) else { break };
            client = Self { address, is_forwarded: true, is_https: hop.is_https };
        }
        client
    }

    /// The part of the network that one party usually has: an IPv4 address, or a /64 of IPv6.
    pub(super) fn network(address: IpAddr) -> IpAddr {
        match address.to_canonical() {
            IpAddr::V6(address) => {
                IpAddr::V6(Ipv6Addr::from_bits(address.to_bits() & !u128::from(u64::MAX)))
            }
            address @ IpAddr::V4(_) => address,
        }
    }
}

/// The hops in the order of the headers: the client first, the last proxy last.
fn hops(headers: &HeaderMap) -> Vec<Hop> {
    // A proxy appends to the bytes that the client sent, which need not be text.
    let values = |name: &str| -> Vec<String> {
        let lines = headers.get_all(name).iter().map(|value| value.as_bytes());
        let elements = lines.flat_map(|line| line.split(|byte| *byte == b','));
        elements.map(|element| String::from_utf8_lossy(element).trim().to_owned()).collect()
    };
    let addresses = values("x-forwarded-for");
    if addresses.is_empty() {
        return values("forwarded").iter().map(|element| forwarded(element)).collect();
    }
    let is_https = values("x-forwarded-proto").last().is_some_and(|scheme| is_https(scheme));
    addresses.iter().map(|text| Hop { address: address(text), is_https }).collect()
}

/// An element of `Forwarded`, such as `for="[2001:db8::1]:4711";proto=https`.
fn forwarded(element: &str) -> Hop {
    let mut hop = Hop { address: None, is_https: false };
    for pair in element.split(';') {
        let (name, value) = pair.split_once('=').unwrap_or_default();
        let value = value.trim().trim_matches('"');
        match name.trim().to_ascii_lowercase().as_str() {
            "for" => hop.address = address(value),
            "proto" => hop.is_https = is_https(value),
            _ => {}
        }
    }
    hop
}

fn is_https(scheme: &str) -> bool {
    scheme.eq_ignore_ascii_case("https")
}

/// An address, perhaps with a port.
fn address(text: &str) -> Option<IpAddr> {
    let bare = text.trim_start_matches('[').trim_end_matches(']').parse::<IpAddr>().ok();
    let with_port = || text.parse::<SocketAddr>().ok().map(|address| address.ip());
    bare.or_else(with_port).map(|address| address.to_canonical())
}

#[cfg(test)]
mod tests {
    use axum::http::{HeaderMap, HeaderName, HeaderValue};
    use ipnet::IpNet;

    use super::Client;

    fn client(peer: &str, lines: &[(&'static str, &str)]) -> (String, bool) {
        let mut headers = HeaderMap::new();
        for (name, value) in lines {
            headers.append(
                HeaderName::from_static(name),
                HeaderValue::from_bytes(value.as_bytes()).unwrap(),
            );
        }
        let proxies: [IpNet; 2] = ["10.0.0.0/8".parse().unwrap(), "fd00::/8".parse().unwrap()];
        let client = Client::of(peer.parse().unwrap(), &headers, &proxies);
        (client.address.to_string(), client.is_https)
    }

    #[test]
    fn only_trusted_proxies_name_the_client() {
        let named = ("x-forwarded-for", "192.0.2.7");
        for (peer, lines, address, is_https) in [
            ("198.51.100.1", &[named][..], "198.51.100.1", false),
            ("10.0.0.1", &[], "10.0.0.1", false),
            ("10.0.0.1", &[named], "192.0.2.7", false),
            ("::ffff:10.0.0.1", &[named, ("x-forwarded-proto", "https")], "192.0.2.7", true),
            // The client sent an address of its choice; the proxy appended the true one.
            ("10.0.0.1", &[("x-forwarded-for", "203.0.113.9, 192.0.2.7")], "192.0.2.7", false),
            ("10.0.0.1", &[("x-forwarded-for", "203.0.113.9"), named], "192.0.2.7", false),
            // An element that is no text hides nothing behind it.
            ("10.0.0.1", &[("x-forwarded-for", "\u{ff}, 192.0.2.7")], "192.0.2.7", false),
            ("10.0.0.1", &[("x-forwarded-for", "192.0.2.7, 10.2.0.1")], "192.0.2.7", false),
            ("10.0.0.1", &[("x-forwarded-for", "192.0.2.7:99")], "192.0.2.7", false),
            ("10.0.0.1", &[("x-forwarded-for", "192.0.2.7, unknown")], "10.0.0.1", false),
            ("10.0.0.1", &[named, ("forwarded", "for=203.0.113.9")], "192.0.2.7", false),
            (
                "fd00::1",
                &[("forwarded", "For=\"[2001:db8::7]:4711\";Proto=https, for=10.1.1.1")],
                "2001:db8::7",
                true,
            ),
            ("10.0.0.1", &[("forwarded", "for=_hidden;proto=https")], "10.0.0.1", false),
        ] {
            assert_eq!(client(peer, lines), (address.to_owned(), is_https), "{peer} {lines:?}");
        }
    }

    #[test]
    fn a_party_has_an_address_or_a_network() {
        let network = |text: &str| Client::network(text.parse().unwrap()).to_string();
        assert_eq!(network("192.0.2.7"), "192.0.2.7");
        assert_eq!(network("::ffff:192.0.2.7"), "192.0.2.7");
        assert_eq!(network("2001:db8:1:2:3:4:5:6"), "2001:db8:1:2::");
    }
}
