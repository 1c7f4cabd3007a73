//! `sci-recon token`: manages the access tokens of labs.

use std::time::Duration;

use clap::{Args, Subcommand};

use super::CliError;
use super::audited::{Change, FolderArguments, audited};
use super::output::print_line;
use super::wait::wait;
use crate::audit::AuditLog;
use crate::cli::error::Result;
use engine::job::{Lab, Label, Role, Secret, Timestamp, TokenId};
use store::{Purpose, Store, StoreError, Token};

/// Create, list and revoke access tokens.
///
/// Once a token exists, the service refuses requests without one.
#[derive(Debug, Args)]
pub struct Arguments {
    #[command(flatten)]
    folder: FolderArguments,
    #[command(subcommand)]
    action: Action,
}

#[derive(Debug, Subcommand)]
enum Action {
    /// Create a token and print it. It is not stored, so it can't be printed again.
    Create(Create),
    /// List all tokens, without their secrets.
    List,
    /// Revoke a token immediately and permanently.
    Revoke {
        /// Identifier of the token, as `list` shows it.
        id: TokenId,
    },
}

#[derive(Debug, Args)]
struct Create {
    /// The lab that the token gives access to. Data that were created without a token belong to `local`.
    #[arg(long, value_name = "NAME")]
    lab: Lab,
    /// read: view and download; submit: also upload, request jobs, cancel and delete; admin: also view /metrics and
    /// /v1/system, and give jobs a priority above 0.
    #[arg(long, value_name = "ROLE", default_value = "submit")]
    role: Role,
    /// Give access to all labs; with the role admin, also to their limits.
    #[arg(long)]
    all_labs: bool,
    /// Expiry of the token: after a time, like 90d or 12h, or at a date, like 2027-01-31T00:00:00Z [default: never].
    #[arg(long, value_name = "WHEN", value_parser = expiry)]
    expires: Option<Timestamp>,
    /// Bytes that the token's uploads may occupy [default: no limit].
    #[arg(long, value_name = "BYTES", value_parser = crate::config::bytes)]
    max_bytes: Option<u64>,
    /// Create the data folder if it does not exist.
    #[arg(long)]
    new: bool,
    /// The person or purpose that the token is for.
    #[arg(long, value_name = "TEXT")]
    note: Option<Label>,
}

pub fn run(arguments: &Arguments) -> Result<()> {
    wait(async {
        let log = arguments.folder.log()?;
        let store = open(arguments).await?;
        let text = act(&store, &log, &arguments.action).await?;
        // This makes earlier copies of the database, which have other tokens, recognizable.
        if !matches!(arguments.action, Action::List) {
            store.advance_generation().await?;
        }
        store.close().await;
        print_line(text)
    })
}

async fn open(arguments: &Arguments) -> Result<Store> {
    let create = match &arguments.action {
        Action::Create(create) => Some(create.new),
        _ => None,
    };
    match (Store::open(&arguments.folder.data, Purpose::Use).await, create) {
        (Err(StoreError::NoFolder(_)), Some(true)) => {
            Ok(Store::open(&arguments.folder.data, Purpose::Serve { accept_database: false })
                .await?)
        }
        (Err(error @ StoreError::NoFolder(_)), Some(false)) => {
            Err(CliError::Input(format!("{error}; create it with --new")))
        }
        (opened, _) => Ok(opened?),
    }
}

async fn act(store: &Store, log: &AuditLog, action: &Action) -> Result<String> {
    match action {
        Action::Create(create) => {
            let id = TokenId::new();
            let object = id.to_string();
            let change = Change { action: "token create", lab: Some(create.lab.clone()), object };
            let secret = Secret::random()
                .map_err(|error| CliError::Failure(format!("no random numbers: {error}")))?;
            let token = create.token(id);
            audited(store, log, change, async || store.add_token(&token, &secret).await).await?;
            Ok(secret.reveal().to_owned())
        }
        Action::List => Ok(table(&store.tokens().await?)),
        Action::Revoke { id } => {
            let tokens = store.tokens().await?;
            let token = tokens.into_iter().map(|(token, _)| token).find(|token| token.id == *id);
            let lab = token.map(|token| token.lab);
            let change = Change { action: "token revoke", lab, object: id.to_string() };
            audited(store, log, change, async || store.revoke_token(*id).await).await?;
            Ok(format!("revoked {id}"))
        }
    }
}

impl Create {
    fn token(&self, id: TokenId) -> Token {
        Token {
            id,
            lab: self.lab.clone(),
            role: self.role,
            all_labs: self.all_labs,
            note: self.note.clone(),
            max_bytes: self.max_bytes,
            created_at: Timestamp::now(),
            expires_at: self.expires,
            used_at: None,
            revoked_at: None,
        }
    }
}

/// Parses a time in the future, or a number of days or hours from now.
fn expiry(text: &str) -> Result<Timestamp, String> {
    let now = Timestamp::now();
    let seconds = |number: &str, unit: u64| {
        let number = number.parse::<u64>().ok().filter(|number| (1..=87_600).contains(number));
        number.map(|number| now.after(Duration::from_secs(number * unit)))
    };
    let moment = match (text.strip_suffix('d'), text.strip_suffix('h')) {
        (Some(days), _) => seconds(days, 86_400),
        (_, Some(hours)) => seconds(hours, 3600),
        _ => text.parse().ok(),
    };
    moment.filter(|moment| *moment > now).ok_or_else(|| {
        format!(
            "{text:?} is not a time in the future; give a duration, like 90d or 12h, or a date, like \
            2027-01-31T00:00:00Z"
        )
    })
}

fn table(tokens: &[(Token, u64)]) -> String {
    let mut lines = vec![format!(
        "{:36}  {:16}  {:6}  {:6}  {:>14}  {:>14}  {:24}  {:24}  {:24}  {:24}  note",
        "id", "lab", "role", "labs", "bytes", "limit", "created", "last used", "expires", "revoked"
    )];
    for (token, bytes) in tokens {
        let limit = token.max_bytes.map_or_else(|| "none".into(), |limit| limit.to_string());
        let moment =
            |at: Option<Timestamp>, none: &str| at.map_or(none.into(), |at| at.to_string());
        lines.push(format!(
            "{:36}  {:16}  {:6}  {:6}  {bytes:>14}  {limit:>14}  {:24}  {:24}  {:24}  {:24}  {}",
            token.id.to_string(),
            token.lab.as_str(),
            token.role.into_str(),
            if token.all_labs { "all" } else { "own" },
            token.created_at.to_string(),
            moment(token.used_at, "never"),
            moment(token.expires_at, "never"),
            moment(token.revoked_at, "no"),
            token.note.as_ref().map_or("", Label::as_str),
        ));
    }
    lines.join("\n")
}

impl From<StoreError> for CliError {
    fn from(error: StoreError) -> Self {
        match error {
            StoreError::NotFound { .. }
            | StoreError::NoFolder(_)
            | StoreError::State(_)
            | StoreError::NotFinal(_)
            | StoreError::Ended(_)
            | StoreError::InUse { .. }
            | StoreError::JobInUse(_)
            | StoreError::FileInUse(_) => Self::Input(error.to_string()),
            other => Self::Failure(other.to_string()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::expiry;
    use engine::job::Timestamp;

    #[test]
    fn an_expiry_lies_in_the_future() {
        let now = Timestamp::now();
        let days = expiry("90d").unwrap().seconds_since(now) / 86_400.0;
        assert!((89.9..90.1).contains(&days), "{days}");
        assert!(expiry("12h").unwrap() > now);
        assert_eq!(expiry("2999-01-31T00:00:00Z").unwrap().to_string(), "2999-01-31T00:00:00.000Z");
        for bad in ["", "d", "0d", "-1d", "90", "99999999999d", "2001-01-31T00:00:00Z", "tomorrow"]
        {
            assert!(expiry(bad).unwrap_err().contains("90d"), "{bad}");
        }
    }
}
