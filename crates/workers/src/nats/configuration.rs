//! Configurations of the message server: one for each node.

use std::fmt;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::str::FromStr;

use rcgen::{BasicConstraints, CertificateParams, DnType, IsCa, Issuer, KeyPair, KeyUsagePurpose};

use super::authority::{Authority, at, write_secret};
use super::connection::ClusterError;

/// The port at which nodes meet each other lies so far above that for clients.
const ROUTES: u16 = 2000;
const CERTIFICATE: &str = "server.pem";
const KEY: &str = "server.key";
/// See `authority.rs`.
const AUTHORITY: &str = "ca.pem";

/// The first version that knows `sync_interval: always`.
const SYNC_ALWAYS: ServerVersion = ServerVersion([2, 10, 0]);

/// A version of nats-server.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct ServerVersion([u32; 3]);

impl FromStr for ServerVersion {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let wrong = || format!("{text:?} is no version of nats-server; one is 2.12 or 2.12.5");
        let mut version = [0; 3];
        let parts: Vec<&str> = text.trim_start_matches('v').split('.').collect();
        if !(2..=3).contains(&parts.len()) {
            return Err(wrong());
        }
        for (place, part) in version.iter_mut().zip(parts) {
            *place = part.parse().map_err(|_| wrong())?;
        }
        Ok(Self(version))
    }
}

impl fmt::Display for ServerVersion {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [major, minor, patch] = self.0;
        write!(f, "{major}.{minor}.{patch}")
    }
}

/// A node of the message server: its host as others reach it, and its port.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Node {
    host: String,
    port: u16,
}

impl FromStr for Node {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let wrong = || format!("{text:?} is no host, and no host:port with a port below 63536");
        let (host, port) = match text.rsplit_once(':') {
            Some((host, port)) => (host, port.parse().map_err(|_| wrong())?),
            None => (text, 4222),
        };
        let is_good = |byte: u8| byte.is_ascii_alphanumeric() || b".-_".contains(&byte);
        if host.is_empty() || !host.bytes().all(is_good) || port > u16::MAX - ROUTES {
            return Err(wrong());
        }
        Ok(Self { host: host.to_owned(), port })
    }
}

/// What was made, and what is to be known of it.
#[derive(Debug)]
pub struct Configured {
    /// A configuration for each node.
    pub files: Vec<PathBuf>,
    /// What could not be had.
    pub warnings: Vec<String>,
}

/// Addresses for clients, separated by commas.
#[must_use]
pub fn url(nodes: &[Node], tls: bool) -> String {
    let scheme = if tls { "tls" } else { "nats" };
    let one = |node: &Node| format!("{scheme}://{}:{}", node.host, node.port);
    nodes.iter().map(one).collect::<Vec<_>>().join(",")
}

/// Makes the certificates, so that [`Authority::create_worker`] finds them.
///
/// # Errors
/// If they can't be made or written.
pub fn make_certificates(folder: &Path, nodes: &[Node]) -> Result<(), ClusterError> {
    let failed = at(folder);
    let mut authority = CertificateParams::default();
    authority.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
    authority.distinguished_name.push(DnType::CommonName, "sci-recon cluster");
    authority.key_usages = vec![KeyUsagePurpose::KeyCertSign, KeyUsagePurpose::DigitalSignature];
    let authority_key = KeyPair::generate().map_err(&failed)?;
    let signed = authority.self_signed(&authority_key).map_err(&failed)?;
    let hosts: Vec<String> = nodes.iter().map(|node| node.host.clone()).collect();
    let mut server = CertificateParams::new(hosts).map_err(&failed)?;
    server.distinguished_name.push(DnType::CommonName, "nats-server");
    let server_key = KeyPair::generate().map_err(&failed)?;
    let issuer = Issuer::new(authority, authority_key);
    let certificate = server.signed_by(&server_key, &issuer).map_err(&failed)?;
    // Nobody needs the authority's key again: another certificate comes with another authority.
    fs::write(folder.join(AUTHORITY), signed.pem()).map_err(at(folder))?;
    fs::write(folder.join(CERTIFICATE), certificate.pem()).map_err(at(folder))?;
    write_secret(&folder.join(KEY), &server_key.serialize_pem())
}

/// Writes the configuration of each node into the folder of the keys. `store` is the folder for
/// messages on the node's machine, `bytes` the most in it. `version` is that of the nodes' nats-server; without it
/// they are taken to have the one of this machine, or a current one.
///
/// # Errors
/// If they can't be written, or nats-server, where it is there, does not take them.
pub fn write(
    authority: &Authority,
    folder: &Path,
    nodes: &[Node],
    (store, bytes): (&Path, u64),
    tls: bool,
    version: Option<ServerVersion>,
) -> Result<Configured, ClusterError> {
    let folder = std::path::absolute(folder).map_err(at(folder))?;
    let store = &std::path::absolute(store).map_err(at(store))?;
    let secret = hex::encode(rand::random::<[u8; 16]>());
    let (mut files, mut warnings) = (Vec::new(), Vec::new());
    let here = find_server().and_then(|path| Some((version_of(&path)?, path)));
    let version = version.or(here.as_ref().map(|(version, _)| *version));
    let sync = version.is_none_or(|version| version >= SYNC_ALWAYS);
    for (n, node) in nodes.iter().enumerate() {
        let name = if nodes.len() > 1 {
            format!("nats-server-{}.conf", n + 1)
        } else {
            "nats-server.conf".to_owned()
        };
        let path = folder.join(name);
        let text = text(
            authority,
            &folder,
            (n, node),
            nodes,
            (store, bytes),
            tls.then_some(()),
            &secret,
            sync,
        )?;
        write_secret(&path, &text)?;
        // An older server than the nodes' may refuse what they know.
        if let Some((_, server)) = here.as_ref().filter(|(here, _)| !sync || *here >= SYNC_ALWAYS) {
            test(server, &path).map_err(|reason| at(&path)(reason))?;
        }
        files.push(path);
    }
    match version {
        Some(version) if !sync => warnings.push(format!(
            "nats-server {version} does not know `sync_interval: always`: after a power cut up to two minutes of \
             messages may be gone, which the server finds and mends. 2.12.5 or later is recommended; where the \
             nodes have another version than this machine, name it with --nats-version"
        )),
        Some(_) => {}
        None => warnings.push(
            "there is no nats-server on this machine to try the configuration with; it is for 2.10 or later, \
             unless --nats-version names an older one"
                .into(),
        ),
    }
    Ok(Configured { files, warnings })
}

#[allow(clippy::too_many_arguments)] // a template has many blanks
fn text(
    authority: &Authority,
    folder: &Path,
    (n, node): (usize, &Node),
    nodes: &[Node],
    (store, bytes): (&Path, u64),
    tls: Option<()>,
    secret: &str,
    sync: bool,
) -> Result<String, ClusterError> {
    let [(system, system_token), (account, account_token)] = authority.accounts()?;
    let sync = if sync {
        "\n  sync_interval: always"
    } else {
        "\n  # With nats-server 2.10 or later: sync_interval: always"
    };
    let store = if nodes.len() > 1 { store.join(format!("n{}", n + 1)) } else { store.into() };
    let certificates = format!(
        "tls {{\n  cert_file: {:?}\n  key_file: {:?}\n  ca_file: {:?}\n}}\n",
        folder.join(CERTIFICATE),
        folder.join(KEY),
        folder.join(AUTHORITY)
    );
    let client_tls = if tls.is_some() { certificates.as_str() } else { "" };
    // A node that is reached on its own machine alone listens there alone.
    let local = node.host.parse::<std::net::IpAddr>().is_ok_and(|address| address.is_loopback());
    let listen = if local { node.host.as_str() } else { "0.0.0.0" };
    let mut text = format!(
        "# Made by `sci-recon cluster init`. Start it with: nats-server -c THIS_FILE\n\
         server_name: \"sci-recon-{}\"\n\
         listen: \"{listen}:{}\"\n\
         jetstream {{\n  store_dir: {store:?}\n  max_file_store: {bytes}{sync}\n}}\n\
         {client_tls}\
         operator: {}\n\
         system_account: {system}\n\
         resolver {{\n  type: full\n  dir: {:?}\n  interval: \"2m\"\n}}\n\
         resolver_preload {{\n  {system}: {system_token}\n  {account}: {account_token}\n}}\n",
        n + 1,
        node.port,
        authority.operator_token()?,
        store.join("accounts"),
    );
    if nodes.len() > 1 {
        let route = |node: &Node| {
            format!("\"nats-route://route:{secret}@{}:{}\"", node.host, node.port + ROUTES)
        };
        let routes: Vec<String> = nodes.iter().map(route).collect();
        let inner = if tls.is_some() { certificates.as_str() } else { "" };
        text += &format!(
            "cluster {{\n  name: \"sci-recon\"\n  listen: \"{listen}:{}\"\n  \
             authorization {{ user: route, password: \"{secret}\" }}\n  routes: [{}]\n{inner}}}\n",
            node.port + ROUTES,
            routes.join(", ")
        );
    }
    Ok(text)
}

/// nats-server on this machine.
fn find_server() -> Option<PathBuf> {
    let named = std::env::var_os("NATS_SERVER").map(PathBuf::from);
    let path = std::env::var_os("PATH").unwrap_or_default();
    let mut folders: Vec<PathBuf> = std::env::split_paths(&path).collect();
    folders.extend(["/usr/sbin", "/usr/local/bin"].map(PathBuf::from));
    let found = folders.into_iter().map(|folder| folder.join("nats-server"));
    named.into_iter().chain(found).find(|path| path.is_file())
}

/// The version of a nats-server; none if it does not say one.
fn version_of(server: &Path) -> Option<ServerVersion> {
    let ran = Command::new(server).arg("--version").output().ok()?;
    let said = String::from_utf8(ran.stdout).ok()?;
    // A version before its release has more behind a dash.
    said.rsplit(": ").next()?.trim().split('-').next()?.parse().ok()
}

/// Has nats-server read a configuration; the reason if it does not take it.
fn test(server: &Path, path: &Path) -> Result<(), String> {
    let ran = Command::new(server).arg("-t").arg("-c").arg(path).output();
    let ran = ran.map_err(|error| error.to_string())?;
    if ran.status.success() {
        return Ok(());
    }
    let said = [ran.stdout, ran.stderr].concat();
    Err(String::from_utf8_lossy(&said).trim().to_owned())
}

#[cfg(test)]
mod tests {
    use super::{Node, SYNC_ALWAYS, ServerVersion, url};

    #[test]
    fn versions_have_two_or_three_numbers() {
        let parse = |text: &str| text.parse::<ServerVersion>();
        assert_eq!(parse("v2.12.5").unwrap().to_string(), "2.12.5");
        assert!(parse("2.12").unwrap() > SYNC_ALWAYS && parse("2.9.10").unwrap() < SYNC_ALWAYS);
        for bad in ["", "2", "2.x", "2.12.5.1"] {
            assert!(parse(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn nodes_have_a_host_and_a_port() {
        let nodes: Vec<Node> =
            ["nats.lab.example", "10.0.0.2:5222"].map(|text| text.parse().unwrap()).to_vec();
        assert_eq!(url(&nodes, true), "tls://nats.lab.example:4222,tls://10.0.0.2:5222");
        for bad in ["", "a b", "host:", "host:70000", "host:64000", "a\"b"] {
            assert!(bad.parse::<Node>().is_err(), "{bad}");
        }
    }
}
