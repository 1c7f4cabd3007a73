//! Table `tokens`: who may come in.

use sqlx::FromRow;

use crate::job::{Lab, Label, Role, Secret, Timestamp, TokenId};
use crate::store::Store;
use crate::store::error::{Result, StoreError};
use crate::store::rows::{integer, sql, sql_as};

/// A token on record, without the secret.
#[derive(Debug, Clone, PartialEq, Eq, FromRow)]
pub struct Token {
    /// Its identifier, which is no secret.
    pub id: TokenId,
    pub lab: Lab,
    pub role: Role,
    /// Whom it was given to.
    pub note: Option<Label>,
    /// Bytes of uploads, and of what is prepared of them, that it may keep here; none: no limit.
    pub max_bytes: Option<u64>,
    pub created_at: Timestamp,
    pub revoked_at: Option<Timestamp>,
}

impl Store {
    /// Records a token by the hash of its secret.
    pub async fn add_token(&self, token: &Token, secret: &Secret) -> Result<()> {
        sql!(
            "INSERT INTO tokens (id, hash, lab, role, note, max_bytes, created_at)
             VALUES (?, ?, ?, ?, ?, ?, ?)",
            [
                token.id,
                secret.hash(),
                &token.lab,
                token.role,
                &token.note,
                token.max_bytes.map(integer),
                token.created_at
            ]
        )
        .execute(&self.writer)
        .await?;
        Ok(())
    }

    /// The token with this secret, unless it was revoked.
    pub async fn token(&self, secret: &Secret) -> Result<Option<Token>> {
        let token = "SELECT * FROM tokens WHERE hash = ? AND revoked_at IS NULL";
        Ok(sql_as!(token, [secret.hash()]).fetch_optional(&self.readers).await?)
    }

    /// Whether a token still opens anything.
    pub async fn token_holds(&self, id: TokenId) -> Result<bool> {
        let token = "SELECT 1 FROM tokens WHERE id = ? AND revoked_at IS NULL";
        Ok(sql!(token, [id]).fetch_optional(&self.readers).await?.is_some())
    }

    /// All tokens, oldest first, each with the bytes that it keeps here.
    pub async fn tokens(&self) -> Result<Vec<(Token, u64)>> {
        let tokens: Vec<Token> =
            sqlx::query_as("SELECT * FROM tokens ORDER BY id").fetch_all(&self.readers).await?;
        let mut listed = Vec::with_capacity(tokens.len());
        for token in tokens {
            let bytes = self.token_bytes(token.id).await?;
            listed.push((token, bytes));
        }
        Ok(listed)
    }

    /// Revokes a token, for ever. A second time changes nothing.
    pub async fn revoke_token(&self, id: TokenId) -> Result<()> {
        let changed = sql!(
            "UPDATE tokens SET revoked_at = coalesce(revoked_at, ?) WHERE id = ?",
            [Timestamp::now(), id]
        )
        .execute(&self.writer)
        .await?;
        if changed.rows_affected() == 0 {
            return Err(StoreError::missing("token", id));
        }
        Ok(())
    }

    /// True if no token was ever made: everyone may do everything then. Revoking the last one does
    /// not open the service again.
    pub async fn is_open(&self) -> Result<bool> {
        let row = sqlx::query("SELECT 1 FROM tokens LIMIT 1").fetch_optional(&self.readers).await?;
        Ok(row.is_none())
    }
}
