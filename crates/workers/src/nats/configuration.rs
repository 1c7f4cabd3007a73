//! Writes configurations of the message server, one for each node.

use std::fmt;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::str::FromStr;

use rcgen::{BasicConstraints, CertificateParams, DnType, IsCa, Issuer, KeyPair, KeyUsagePurpose};

use super::authority::{Authority, at, write_secret};
use super::connection::ClusterError;

/// Offset from a node's port for clients to its port for other nodes.
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
        let wrong = || format!("{text:?} is not a version of nats-server such as 2.12 or 2.12.5");
        let mut version = [0; 3];
        let parts: Vec<&str> = text.trim_start_matches('v').split('.').collect();
        if !(2..=3).contains(&parts.len()) {
            return Err(wrong());
        }
        for (number, part) in version.iter_mut().zip(parts) {
            *number = part.parse().map_err(|_| wrong())?;
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

/// A node of the message server: the host name that others use, and the port.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Node {
    host: String,
    port: u16,
}

impl FromStr for Node {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let wrong =
            || format!("{text:?} is neither a host nor a host:port with a port below 63536");
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

/// The configurations that were written, and warnings about them.
#[derive(Debug)]
pub struct Configured {
    /// A configuration for each node.
    pub files: Vec<PathBuf>,
    /// Properties that the configurations lack.
    pub warnings: Vec<String>,
}

/// Addresses for clients, separated by commas.
#[must_use]
pub fn url(nodes: &[Node], tls: bool) -> String {
    let scheme = if tls { "tls" } else { "nats" };
    let one = |node: &Node| format!("{scheme}://{}:{}", node.host, node.port);
    nodes.iter().map(one).collect::<Vec<_>>().join(",")
}

/// Writes the certificates, which [`Authority::create_worker`] then adds to credentials.
/// Errors: they can't be generated or written.
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
    // The authority's key is dropped: a new certificate gets a new authority.
    fs::write(folder.join(AUTHORITY), signed.pem()).map_err(at(folder))?;
    fs::write(folder.join(CERTIFICATE), certificate.pem()).map_err(at(folder))?;
    write_secret(&folder.join(KEY), &server_key.serialize_pem())
}

/// Writes the configuration of each node into the folder of the keys. `store` is the folder for messages on the
/// node's machine, and `bytes` limits its size. `version` is the nodes' version of nats-server. The default is the
/// version on this machine, or a current one if there is none.
/// Errors: they can't be written, or a nats-server on this machine rejects them.
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
    let installed = find_server().and_then(|path| Some((version_of(&path)?, path)));
    let version = version.or(installed.as_ref().map(|(version, _)| *version));
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
        // A server that is older than the nodes' may reject options that they know.
        let tester = installed.as_ref().filter(|(installed, _)| !sync || *installed >= SYNC_ALWAYS);
        if let Some((_, server)) = tester {
            test(server, &path).map_err(|reason| at(&path)(reason))?;
        }
        files.push(path);
    }
    match version {
        Some(version) if !sync => warnings.push(format!(
            "nats-server {version} does not know `sync_interval: always`: a power cut may lose up to two minutes of \
            messages, which the server detects and repairs. 2.12.5 or later is recommended. If the nodes have \
            another version than this machine, state it with --nats-version"
        )),
        Some(_) => {}
        None => warnings.push(
            "this machine has no nats-server to test the configuration with; it is for version 2.10 or later \
            unless --nats-version states an older one"
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
    // A node on a loopback address listens only on that address.
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

/// Finds nats-server on this machine.
fn find_server() -> Option<PathBuf> {
    let named = std::env::var_os("NATS_SERVER").map(PathBuf::from);
    let path = std::env::var_os("PATH").unwrap_or_default();
    let mut folders: Vec<PathBuf> = std::env::split_paths(&path).collect();
    folders.extend(["/usr/sbin", "/usr/local/bin"].map(PathBuf::from));
    let candidates = folders.into_iter().map(|folder| folder.join("nats-server"));
    named.into_iter().chain(candidates).find(|path| path.is_file())
}

/// Runs a nats-server to get its version. Returns `None` if it prints none.
fn version_of(server: &Path) -> Option<ServerVersion> {
    let ran = Command::new(server).arg("--version").output().ok()?;
    let output = String::from_utf8(ran.stdout).ok()?;
    // A pre-release has a suffix after a dash.
    output.rsplit(": ").next()?.trim().split('-').next()?.parse().ok()
}

/// Tests a configuration with nats-server. The error is its output.
fn test(server: &Path, path: &Path) -> Result<(), String> {
    let ran = Command::new(server).arg("-t").arg("-c").arg(path).output();
    let ran = ran.map_err(|error| error.to_string())?;
    if ran.status.success() {
        return Ok(());
    }
    let output = [ran.stdout, ran.stderr].concat();
    Err(String::from_utf8_lossy(&output).trim().to_owned())
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
