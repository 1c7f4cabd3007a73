//! Who may do what on the message server: an operator whom the servers trust, one account for the
//! service, and users in it, each with a token (JWT) that names its rights and its end. All are made
//! here, without the server; only what is revoked is told to it, through a connection, so that it may
//! be on other machines.
//!
//! Tokens as in the NATS documentation ("JWT claims", version 2), signed with Ed25519.

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

/// The file with the keys, and with all that was made with them.
const FILE: &str = "cluster.json";
/// The credential of the server, `sci-recon serve`.
pub const HUB: &str = "hub.creds";
/// The credential that tells the message server of revocations.
const SYSTEM: &str = "system.creds";
/// The certificate by which workers know the message server.
const CERTIFICATE: &str = "ca.pem";

/// The keys of a cluster, and the credentials that were made with them.
#[derive(Debug, Serialize, Deserialize)]
pub struct Authority {
    #[serde(skip)]
    folder: PathBuf,
    /// Where workers reach the message server.
    url: String,
    operator: String,
    system: String,
    account: String,
    /// When the account's token was last made: the server believes the newest.
    changed_at: i64,
    /// Credentials of workers, in the order in which they were made.
    workers: Vec<Issued>,
}

/// A worker's credential.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Issued {
    /// A name for people.
    pub name: String,
    /// The pool whose subjects it opens.
    pub pool: Pool,
    /// Its public key.
    pub key: String,
    /// When it was made, and when it ends, in seconds of Unix time.
    pub issued_at: i64,
    /// The end.
    pub expires_at: i64,
    /// When it was revoked.
    pub revoked_at: Option<i64>,
}

impl Authority {
    /// Makes new keys, and a folder for them.
    ///
    /// # Errors
    /// If the folder has keys already, or can't be written.
    pub fn create(folder: &Path, url: &str) -> Result<Self, ClusterError> {
        let path = folder.join(FILE);
        if path.exists() {
            let reason = "there are keys already; credentials made with them would be void".into();
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

    /// Writes the credentials of the server and of the one who revokes. The certificates must be there
    /// by then, if there are to be any.
    ///
    /// # Errors
    /// If they can't be written.
    pub fn write_own_credentials(&self) -> Result<(), ClusterError> {
        let header = format!("url: {}\n{}", self.url, self.certificate()?);
        let all = json!({"pub": {}, "sub": {}});
        for (name, user, account) in [(HUB, "hub", &self.account), (SYSTEM, "system", &self.system)]
        {
            let path = self.folder.join(name);
            write_user(&path, &KeyPair::new_user(), &pair(account)?, user, &all, None, &header)?;
        }
        Ok(())
    }

    /// The certificate of the authority, as PEM; nothing where nothing is encrypted.
    fn certificate(&self) -> Result<String, ClusterError> {
        let path = self.folder.join(CERTIFICATE);
        match fs::read_to_string(&path) {
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(String::new()),
            read => read.map_err(at(&path)),
        }
    }

    /// The keys in a folder.
    ///
    /// # Errors
    /// If there are none, or they can't be read.
    pub fn open(folder: &Path) -> Result<Self, ClusterError> {
        let path = folder.join(FILE);
        let text = fs::read_to_string(&path).map_err(at(&path))?;
        let mut found: Self = serde_json::from_str(&text).map_err(at(&path))?;
        found.folder = folder.to_owned();
        Ok(found)
    }

    /// The credentials of workers.
    #[must_use]
    pub fn workers(&self) -> &[Issued] {
        &self.workers
    }

    /// The operator's token, for the configuration of the message server.
    ///
    /// # Errors
    /// If the keys are damaged.
    pub fn operator_token(&self) -> Result<String, ClusterError> {
        let operator = pair(&self.operator)?;
        let nats = json!({
            "type": "operator", "version": 2, "system_account": pair(&self.system)?.public_key(),
        });
        token(&operator, &operator.public_key(), "sci-recon", nats, self.changed_at, None)
    }

    /// Public key and token of the system account and of the service's.
    ///
    /// # Errors
    /// If the keys are damaged.
    pub fn accounts(&self) -> Result<[(String, String); 2], ClusterError> {
        let system = pair(&self.system)?.public_key();
        let operator = pair(&self.operator)?;
        let nats = json!({
            "type": "account", "version": 2, "limits": limits(false),
            "default_permissions": {"pub": {}, "sub": {}},
        });
        let of_system = token(&operator, &system, "SYS", nats, self.changed_at, None)?;
        Ok([(system, of_system), self.account()?])
    }

    /// Public key and token of the service's account, with all that is revoked.
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

    /// Makes a credential for the workers of a pool, which ends after so many days, and writes it to a
    /// file that its owner alone may read.
    ///
    /// # Errors
    /// If there is a good one of this name, or the file can't be written.
    pub fn create_worker(
        &mut self,
        pool: &Pool,
        name: &str,
        days: u32,
        out: &Path,
    ) -> Result<(), ClusterError> {
        let taken = |issued: &Issued| issued.name == name && issued.revoked_at.is_none();
        if self.workers.iter().any(taken) {
            let reason = format!("there is one called {name:?}: revoke it first, or name another");
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
            "# A credential for workers of the pool {pool}, called {name}. Keep it as a password.\n\
             url: {}\npool: {pool}\ninbox: {inbox}\n{authority}",
            self.url
        );
        let account = pair(&self.account)?;
        write_user(out, &user, &account, name, &nats, Some(expires_at), &header)?;
        let (name, pool) = (name.to_owned(), pool.clone());
        self.workers.push(Issued { name, pool, key, issued_at, expires_at, revoked_at: None });
        self.save()
    }

    /// Revokes the credentials of a pool, or the one of this name in it. Gives their names. The message
    /// server learns of it by [`Authority::publish`].
    ///
    /// # Errors
    /// If there is none, or the folder can't be written.
    pub fn revoke(&mut self, pool: &Pool, name: Option<&str>) -> Result<Vec<String>, ClusterError> {
        let now = seconds();
        let mut revoked = Vec::new();
        for worker in &mut self.workers {
            let meant = worker.pool == *pool && name.is_none_or(|name| name == worker.name);
            if meant && worker.revoked_at.is_none() {
                worker.revoked_at = Some(now);
                revoked.push(worker.name.clone());
            }
        }
        let known =
            |worker: &Issued| worker.pool == *pool && name.is_none_or(|name| name == worker.name);
        if !self.workers.iter().any(known) {
            let reason = format!("there is no such credential for the pool {pool}");
            let path = self.folder.join(FILE).display().to_string();
            return Err(ClusterError::Authority { path, reason });
        }
        self.changed_at = now.max(self.changed_at + 1);
        self.save()?;
        Ok(revoked)
    }

    /// Tells the message server what is revoked; it cuts off who is connected.
    ///
    /// # Errors
    /// If it can't be reached, or does not take the token.
    pub async fn publish(&self) -> Result<(), ClusterError> {
        let credential = Credential::read(&self.folder.join(SYSTEM))?;
        let connection = Access::new(None, &credential, "sci-recon cluster")?.connect().await?;
        let (_, token) = self.account()?;
        let asked = connection.client.request("$SYS.REQ.CLAIMS.UPDATE", token.into()).await;
        let answer = asked.map_err(ClusterError::nats("tell what is revoked"))?;
        let answer: Value = serde_json::from_slice(&answer.payload)
            .map_err(ClusterError::nats("read the answer to what is revoked"))?;
        match answer["data"]["code"].as_u64() {
            Some(200) => Ok(()),
            _ => Err(ClusterError::nats("tell what is revoked")(answer)),
        }
    }

    fn save(&self) -> Result<(), ClusterError> {
        let path = self.folder.join(FILE);
        let text = serde_json::to_string_pretty(self).map_err(at(&path))?;
        write_secret(&path, &text)
    }
}

/// What the workers of a pool may publish: to the hub, in their name; requests for their own tiles and
/// inputs; the frames that they made.
fn worker_may_publish(pool: &Pool) -> Vec<String> {
    let (tasks, inputs) = (names::TASKS, names::INPUTS);
    let asks = ["hello", "begin", "beat", "want"].map(|what| names::ask(what, pool));
    let mut subjects = asks.to_vec();
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

/// An account without limits, with streams or without.
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

/// A token about `subject`, signed by `issuer`.
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

/// Writes a file that its owner alone may read, and brings it to its place at once.
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
