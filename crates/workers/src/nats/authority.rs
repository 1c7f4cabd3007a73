//! Keys and credentials of the message server. The servers trust an operator. The operator signs one account for the
//! service, and the account signs users. Each user has a token (JWT) that states rights and an expiry time.
//!
//! Credentials are created without the server. Only revocations are sent to it, over a connection, so that it may
//! run on other machines.
//!
//! Tokens follow the NATS documentation ("JWT claims", version 2) and are signed with Ed25519.

use std::fs;
use std::io::Write;
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

use base64::Engine;
use base64::engine::general_purpose::URL_SAFE_NO_PAD;
use nkeys::KeyPair;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value, json};
use sha2::{Digest, Sha512_256};

use super::connection::{Access, ClusterError, Credential};
use super::names;
use engine::job::{Pool, Timestamp};

/// The file with the keys and the list of issued credentials.
const FILE: &str = "cluster.json";
/// The credential of the server, `sci-recon serve`.
pub const HUB: &str = "hub.creds";
/// The credential that sends revocations to the message server.
const SYSTEM: &str = "system.creds";
/// The certificate with which workers verify the message server.
const CERTIFICATE: &str = "ca.pem";

/// The keys of a cluster, and the credentials that were issued with them.
#[derive(Debug, Serialize, Deserialize)]
pub struct Authority {
    #[serde(skip)]
    folder: PathBuf,
    /// Address of the message server for workers.
    url: String,
    operator: String,
    system: String,
    account: String,
    /// Time of the account's latest token, in Unix seconds. The server accepts the newest token.
    changed_at: i64,
    /// Credentials of workers, oldest first.
    workers: Vec<Issued>,
}

/// A worker's credential.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Issued {
    /// The name that a person chose.
    pub name: String,
    /// The pool that it gives access to.
    pub pool: Pool,
    /// The public key of the user.
    pub key: String,
    /// Time of issue, in Unix seconds.
    pub issued_at: i64,
    /// Expiry time, in Unix seconds.
    pub expires_at: i64,
    /// Time of revocation, in Unix seconds.
    pub revoked_at: Option<i64>,
}

impl Authority {
    /// Creates new keys in a folder.
    /// Errors: the folder already contains keys, or can't be written.
    pub fn create(folder: &Path, url: &str) -> Result<Self, ClusterError> {
        let path = folder.join(FILE);
        if path.exists() {
            let reason =
                "this file already contains keys; new keys would invalidate their credentials"
                    .into();
            return Err(ClusterError::Authority { path: path.display().to_string(), reason });
        }
        fs::create_dir_all(folder).map_err(at(folder))?;
        let seed = |pair: KeyPair| pair.seed().map_err(key);
        let authority = Self {
            folder: folder.to_owned(),
            url: url.to_owned(),
            operator: seed(KeyPair::new_operator())?,
            system: seed(KeyPair::new_account())?,
            account: seed(KeyPair::new_account())?,
            changed_at: seconds(),
            workers: Vec::new(),
        };
        authority.save()?;
        Ok(authority)
    }

    /// Writes the credential of the server and the credential for revocations. Create certificates before, if the
    /// connections are to be encrypted.
    /// Errors: they can't be written.
    pub fn write_own_credentials(&self) -> Result<(), ClusterError> {
        let header = format!("url: {}\n{}", self.url, self.certificate()?);
        let unrestricted = json!({"pub": {}, "sub": {}});
        for (name, user, account) in [(HUB, "hub", &self.account), (SYSTEM, "system", &self.system)]
        {
            let path = self.folder.join(name);
            let (key, account) = (KeyPair::new_user(), pair(account)?);
            write_user(&path, &key, &account, user, &unrestricted, None, &header)?;
        }
        Ok(())
    }

    /// The certificate of the authority as PEM. It is empty if connections are not encrypted.
    fn certificate(&self) -> Result<String, ClusterError> {
        let path = self.folder.join(CERTIFICATE);
        match fs::read_to_string(&path) {
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(String::new()),
            read => read.map_err(at(&path)),
        }
    }

    /// Reads the keys in a folder.
    /// Errors: the folder contains no keys, or they can't be read.
    pub fn open(folder: &Path) -> Result<Self, ClusterError> {
        let path = folder.join(FILE);
        let text = fs::read_to_string(&path).map_err(at(&path))?;
        let mut authority: Self = serde_json::from_str(&text).map_err(at(&path))?;
        authority.folder = folder.to_owned();
        Ok(authority)
    }

    /// The credentials of workers.
    #[must_use]
    pub fn workers(&self) -> &[Issued] {
        &self.workers
    }

    /// The operator's token, for the configuration of the message server.
    /// Errors: the keys are damaged.
    pub fn operator_token(&self) -> Result<String, ClusterError> {
        let operator = pair(&self.operator)?;
        let nats = json!({
            "type": "operator", "version": 2, "system_account": pair(&self.system)?.public_key(),
        });
        token(&operator, &operator.public_key(), "sci-recon", nats, self.changed_at, None)
    }

    /// Public keys and tokens of the system account and of the service's account.
    /// Errors: the keys are damaged.
    pub fn accounts(&self) -> Result<[(String, String); 2], ClusterError> {
        let system = pair(&self.system)?.public_key();
        let operator = pair(&self.operator)?;
        let nats = json!({
            "type": "account", "version": 2, "limits": limits(false),
            "default_permissions": {"pub": {}, "sub": {}},
        });
        let system_token = token(&operator, &system, "SYS", nats, self.changed_at, None)?;
        Ok([(system, system_token), self.account()?])
    }

    /// Public key and token of the service's account. The token lists all revocations.
    fn account(&self) -> Result<(String, String), ClusterError> {
        let key = pair(&self.account)?.public_key();
        let revoked: Map<String, Value> = self
            .workers
            .iter()
            .filter_map(|worker| Some((worker.key.clone(), worker.revoked_at?.into())))
            .collect();
        let nats = json!({
            "type": "account", "version": 2, "limits": limits(true), "revocations": revoked,
            "default_permissions": {"pub": {}, "sub": {}},
        });
        let token = token(&pair(&self.operator)?, &key, "SCI", nats, self.changed_at, None)?;
        Ok((key, token))
    }

    /// Issues a credential for the workers of a pool, which expires after `days` days. The file is readable by its
    /// owner only.
    /// Errors: a valid credential has the same name, or the file can't be written.
    pub fn create_worker(
        &mut self,
        pool: &Pool,
        name: &str,
        days: u32,
        out: &Path,
    ) -> Result<(), ClusterError> {
        let has_name = |issued: &Issued| issued.name == name && issued.revoked_at.is_none();
        if self.workers.iter().any(has_name) {
            let reason = format!(
                "a credential is already called {name:?}: revoke it first, or choose another name"
            );
            let path = self.folder.join(FILE).display().to_string();
            return Err(ClusterError::Authority { path, reason });
        }
        let user = KeyPair::new_user();
        let (issued_at, key) = (seconds(), user.public_key());
        let expires_at = issued_at + i64::from(days) * 86_400;
        let inbox = format!("_INBOX.{key}");
        let nats = json!({
            "pub": {"allow": worker_may_publish(pool)},
            "sub": {"allow": [format!("sci.v1.tell.{pool}.>"), format!("{inbox}.>")]},
        });
        let authority = self.certificate()?;
        let header = format!(
            "# Credential {name:?} for workers of the pool {pool}. Keep it secret, like a password.\n\
             url: {}\npool: {pool}\ninbox: {inbox}\n{authority}",
            self.url
        );
        let account = pair(&self.account)?;
        write_user(out, &user, &account, name, &nats, Some(expires_at), &header)?;
        let (name, pool) = (name.to_owned(), pool.clone());
        self.workers.push(Issued { name, pool, key, issued_at, expires_at, revoked_at: None });
        self.save()
    }

    /// Revokes the credentials of a pool, or the one called `name`. Returns the names of those that were revoked now.
    /// [`Authority::publish`] sends the revocations to the message server.
    /// Errors: no credential matches, or the folder can't be written.
    pub fn revoke(&mut self, pool: &Pool, name: Option<&str>) -> Result<Vec<String>, ClusterError> {
        let now = seconds();
        let matches =
            |worker: &Issued| worker.pool == *pool && name.is_none_or(|name| name == worker.name);
        let mut revoked = Vec::new();
        for worker in &mut self.workers {
            if matches(worker) && worker.revoked_at.is_none() {
                worker.revoked_at = Some(now);
                revoked.push(worker.name.clone());
            }
        }
        if !self.workers.iter().any(matches) {
            let reason = format!("there is no such credential for the pool {pool}");
            let path = self.folder.join(FILE).display().to_string();
            return Err(ClusterError::Authority { path, reason });
        }
        self.changed_at = now.max(self.changed_at + 1);
        self.save()?;
        Ok(revoked)
    }

    /// Sends the revocations to the message server, which disconnects the revoked users.
    /// Errors: it can't be reached, or does not accept the token.
    pub async fn publish(&self) -> Result<(), ClusterError> {
        let credential = Credential::read(&self.folder.join(SYSTEM))?;
        let connection = Access::new(None, &credential, "sci-recon cluster")?.connect().await?;
        let (_, token) = self.account()?;
        let answer = connection.client.request("$SYS.REQ.CLAIMS.UPDATE", token.into()).await;
        let answer = answer.map_err(ClusterError::nats("send the revocations"))?;
        let answer: Value = serde_json::from_slice(&answer.payload)
            .map_err(ClusterError::nats("read the answer to the revocations"))?;
        match answer["data"]["code"].as_u64() {
            Some(200) => Ok(()),
            _ => Err(ClusterError::nats("send the revocations")(answer)),
        }
    }

    fn save(&self) -> Result<(), ClusterError> {
        let path = self.folder.join(FILE);
        let text = serde_json::to_string_pretty(self).map_err(at(&path))?;
        write_secret(&path, &text)
    }
}

/// Lists the subjects to which the workers of a pool may publish: messages to the hub, requests for the pool's tiles
/// and inputs, acknowledgements and frames.
fn worker_may_publish(pool: &Pool) -> Vec<String> {
    let (tasks, inputs) = (names::TASKS, names::INPUTS);
    let mut subjects =
        ["hello", "begin", "beat", "want"].map(|kind| names::ask(kind, pool)).to_vec();
    subjects.extend([
        names::event(pool),
        format!("sci.v1.out.{pool}.>"),
        format!("$JS.API.CONSUMER.INFO.{tasks}.{pool}"),
        format!("$JS.API.CONSUMER.MSG.NEXT.{tasks}.{pool}"),
        format!("$JS.ACK.{tasks}.{pool}.>"),
        format!("$JS.API.DIRECT.GET.{inputs}.sci.v1.in.{pool}.>"),
    ]);
    subjects
}

/// Limits of an account: none, except that it may be denied streams.
fn limits(streams: bool) -> Value {
    let storage = if streams { -1 } else { 0 };
    json!({
        "subs": -1, "data": -1, "payload": -1, "imports": -1, "exports": -1, "wildcards": true,
        "conn": -1, "leaf": -1, "mem_storage": storage, "disk_storage": storage,
        "streams": storage, "consumer": storage,
    })
}

fn write_user(
    path: &Path,
    user: &KeyPair,
    account: &KeyPair,
    name: &str,
    rights: &Value,
    expires_at: Option<i64>,
    header: &str,
) -> Result<(), ClusterError> {
    let nats = json!({
        "type": "user", "version": 2, "subs": -1, "data": -1, "payload": -1,
        "pub": rights["pub"], "sub": rights["sub"],
    });
    let token = token(account, &user.public_key(), name, nats, seconds(), expires_at)?;
    let seed = user.seed().map_err(key)?;
    write_secret(
        path,
        &format!(
            "{header}-----BEGIN NATS USER JWT-----\n{token}\n------END NATS USER JWT------\n\n\
             -----BEGIN USER NKEY SEED-----\n{seed}\n------END USER NKEY SEED------\n"
        ),
    )
}

/// Makes a token about `subject`, signed by `issuer`.
fn token(
    issuer: &KeyPair,
    subject: &str,
    name: &str,
    nats: Value,
    issued_at: i64,
    expires_at: Option<i64>,
) -> Result<String, ClusterError> {
    let mut claims = json!({
        "iat": issued_at, "iss": issuer.public_key(), "name": name, "nats": nats, "sub": subject,
    });
    if let Some(end) = expires_at {
        claims["exp"] = end.into();
    }
    let digest = Sha512_256::digest(claims.to_string().as_bytes());
    claims["jti"] = data_encoding::BASE32_NOPAD.encode(&digest).into();
    let header = json!({"typ": "JWT", "alg": "ed25519-nkey"});
    let part = |value: &Value| URL_SAFE_NO_PAD.encode(value.to_string());
    let text = format!("{}.{}", part(&header), part(&claims));
    let signature = issuer.sign(text.as_bytes()).map_err(key)?;
    Ok(format!("{text}.{}", URL_SAFE_NO_PAD.encode(signature)))
}

/// Writes a file that only its owner may read. It replaces an earlier file in one step.
pub fn write_secret(path: &Path, text: &str) -> Result<(), ClusterError> {
    let mut draft = path.as_os_str().to_owned();
    draft.push(".new");
    let draft = PathBuf::from(draft);
    let write = || {
        let mut options = fs::OpenOptions::new();
        let mut file = options.write(true).create(true).truncate(true).mode(0o600).open(&draft)?;
        file.write_all(text.as_bytes())?;
        file.sync_all()?;
        fs::rename(&draft, path)
    };
    write().map_err(at(path))
}

fn pair(seed: &str) -> Result<KeyPair, ClusterError> {
    KeyPair::from_seed(seed).map_err(key)
}

fn key(error: nkeys::error::Error) -> ClusterError {
    ClusterError::Authority { path: "keys".into(), reason: error.to_string() }
}

pub fn at<E: std::fmt::Display>(path: &Path) -> impl Fn(E) -> ClusterError {
    move |error| {
        let path = path.display().to_string();
        ClusterError::Authority { path, reason: error.to_string() }
    }
}

fn seconds() -> i64 {
    Timestamp::now().0 / 1000
}
