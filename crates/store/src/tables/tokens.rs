//! Tables `tokens` and `sessions`: access to the service.

use super::labs;
use crate::Store;
use crate::columns::{from_row, sql, sql_as};
use crate::error::{Result, StoreError};
use engine::job::{Lab, Label, Role, Secret, Timestamp, TokenId};

/// Milliseconds to which the last use of a token is known, so that few requests write.
const USE_NOTED: i64 = 300_000;
/// Sessions of a token at the same time; the oldest give way.
const SESSIONS: u32 = 64;

/// A token, without the secret.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Token {
    /// Its identifier, which is no secret.
    pub id: TokenId,
    pub lab: Lab,
    pub role: Role,
    /// True if it is good for every lab, and not for its own alone.
    pub all_labs: bool,
    /// Whom it was given to.
    pub note: Option<Label>,
    /// Limit for the bytes of its uploads and of the arrays prepared from them; `None` for no limit.
    pub max_bytes: Option<u64>,
    pub created_at: Timestamp,
    /// From when on it is worth nothing; none: never.
    pub expires_at: Option<Timestamp>,
    /// When it last opened something, to within five minutes.
    pub used_at: Option<Timestamp>,
    pub revoked_at: Option<Timestamp>,
}

from_row!(Token, row => {
    id,
    lab,
    role,
    all_labs,
    note,
    max_bytes,
    created_at,
    expires_at,
    used_at,
    revoked_at,
});

impl Token {
    /// True if its last use was noted so long ago that this one is to be noted.
    pub fn is_use_due(&self) -> bool {
        self.used_at.is_none_or(|used| used <= noted_before())
    }
}

fn noted_before() -> Timestamp {
    Timestamp(Timestamp::now().0 - USE_NOTED)
}

impl Store {
    /// Records a token by the hash of its secret, and its lab with it.
    pub async fn add_token(&self, token: &Token, secret: &Secret) -> Result<()> {
        let mut transaction = self.write().await?;
        labs::know(&mut transaction, &token.lab).await?;
        sql!(
            "INSERT INTO tokens (id, hash, lab, role, all_labs, note, max_bytes, created_at, expires_at)
             VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)",
            [
                token.id,
                secret.hash(),
                &token.lab,
                token.role,
                token.all_labs,
                &token.note,
                token.max_bytes,
                token.created_at,
                token.expires_at
            ]
        )
        .execute(&mut *transaction)
        .await?;
        Ok(transaction.commit().await?)
    }

    /// The token with this secret, unless it was revoked or has expired.
    pub async fn token(&self, secret: &Secret) -> Result<Option<Token>> {
        let token = "SELECT * FROM tokens
                     WHERE hash = ? AND revoked_at IS NULL AND (expires_at IS NULL OR expires_at > ?)";
        let token = sql_as!(token, [secret.hash(), Timestamp::now()]);
        token.fetch_optional(&self.readers).await
    }

    /// True if a token is valid.
    pub async fn token_holds(&self, id: TokenId) -> Result<bool> {
        let token = "SELECT 1 FROM tokens
                     WHERE id = ? AND revoked_at IS NULL AND (expires_at IS NULL OR expires_at > ?)";
        let token = sql!(token, [id, Timestamp::now()]);
        Ok(token.fetch_optional(&self.readers).await?.is_some())
    }

    /// The token for which the session with this secret stands, unless either has ended.
    pub async fn token_of_session(&self, secret: &Secret) -> Result<Option<Token>> {
        let token = "SELECT tokens.* FROM sessions JOIN tokens ON tokens.id = token
                     WHERE sessions.hash = ?1 AND sessions.expires_at > ?2
                       AND revoked_at IS NULL AND (tokens.expires_at IS NULL OR tokens.expires_at > ?2)";
        let token = sql_as!(token, [secret.hash(), Timestamp::now()]);
        token.fetch_optional(&self.readers).await
    }

    /// Records a session by the hash of its secret. Expired ones are deleted.
    pub async fn add_session(
        &self,
        token: TokenId,
        secret: &Secret,
        expires_at: Timestamp,
    ) -> Result<()> {
        let now = Timestamp::now();
        let mut transaction = self.write().await?;
        sql!("DELETE FROM sessions WHERE expires_at <= ?", [now])
            .execute(&mut *transaction)
            .await?;
        sql!(
            "INSERT INTO sessions (hash, token, created_at, expires_at) VALUES (?, ?, ?, ?)",
            [secret.hash(), token, now, expires_at]
        )
        .execute(&mut *transaction)
        .await?;
        sql!(
            "DELETE FROM sessions WHERE hash IN
                 (SELECT hash FROM sessions WHERE token = ?
                  ORDER BY created_at DESC, hash LIMIT -1 OFFSET ?)",
            [token, SESSIONS]
        )
        .execute(&mut *transaction)
        .await?;
        Ok(transaction.commit().await?)
    }

    /// Ends a session. One that has ended already is no error.
    pub async fn end_session(&self, secret: &Secret) -> Result<()> {
        sql!("DELETE FROM sessions WHERE hash = ?", [secret.hash()])
            .execute(self.writer()?)
            .await?;
        Ok(())
    }

    /// Notes that a token was used, unless that was noted a moment ago.
    pub async fn note_use(&self, id: TokenId) -> Result<()> {
        sql!(
            "UPDATE tokens SET used_at = ?1 WHERE id = ?2 AND (used_at IS NULL OR used_at <= ?3)",
            [Timestamp::now(), id, noted_before()]
        )
        .execute(self.writer()?)
        .await?;
        Ok(())
    }

    /// All tokens, oldest first, each with the bytes that it keeps here.
    pub async fn tokens(&self) -> Result<Vec<(Token, u64)>> {
        let tokens: Vec<Token> =
            sql_as!("SELECT * FROM tokens ORDER BY id").fetch_all(&self.readers).await?;
        let mut listed = Vec::with_capacity(tokens.len());
        for token in tokens {
            let bytes = self.token_bytes(token.id).await?;
            listed.push((token, bytes));
        }
        Ok(listed)
    }

    /// Revokes a token, for ever. Repeating it changes nothing.
    pub async fn revoke_token(&self, id: TokenId) -> Result<()> {
        let changed = sql!(
            "UPDATE tokens SET revoked_at = coalesce(revoked_at, ?) WHERE id = ?",
            [Timestamp::now(), id]
        )
        .execute(self.writer()?)
        .await?;
        if changed.rows_affected() == 0 {
            return Err(StoreError::missing("token", id));
        }
        Ok(())
    }

    /// True if no token was ever made: everyone may do everything then. Revoking the last one does
    /// not open the service again.
    pub async fn is_open(&self) -> Result<bool> {
        let row = sql!("SELECT 1 FROM tokens LIMIT 1").fetch_optional(&self.readers).await?;
        Ok(row.is_none())
    }
}
