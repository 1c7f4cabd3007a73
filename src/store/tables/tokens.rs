//! Table `tokens`: who may come in.

use sqlx::Row;
use sqlx::sqlite::SqliteRow;

use crate::job::{Lab, Label, Role, Secret, Timestamp, TokenId};
use crate::store::Store;
use crate::store::error::StoreError;
use crate::store::rows::{integer, number, number_if, parsed, parsed_if};

/// A token on record, without the secret.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Token {
    /// Its identifier, which is no secret.
    pub id: TokenId,
    /// Whose data it opens.
    pub lab: Lab,
    /// What it is good for.
    pub role: Role,
    /// Whom it was given to.
    pub note: Option<Label>,
    /// Bytes of uploads that it may keep here; none: no limit.
    pub max_bytes: Option<u64>,
    /// When it was made.
    pub created_at: Timestamp,
    /// When it was revoked, if it was.
    pub revoked_at: Option<Timestamp>,
}

impl Store {
    /// Records a token by the hash of its secret.
    pub async fn add_token(&self, token: &Token, secret: &Secret) -> Result<(), StoreError> {
        sqlx::query(
            "INSERT INTO tokens (id, hash, lab, role, note, max_bytes, created_at)
             VALUES (?, ?, ?, ?, ?, ?, ?)",
        )
        .bind(token.id.to_string())
        .bind(secret.hash().to_string())
        .bind(token.lab.as_str())
        .bind(token.role.name())
        .bind(token.note.as_ref().map(Label::as_str))
        .bind(token.max_bytes.map(integer))
        .bind(token.created_at.0)
        .execute(&self.writer)
        .await?;
        Ok(())
    }

    /// The token with this secret, unless it was revoked.
    pub async fn token(&self, secret: &Secret) -> Result<Option<Token>, StoreError> {
        let row = sqlx::query("SELECT * FROM tokens WHERE hash = ? AND revoked_at IS NULL")
            .bind(secret.hash().to_string())
            .fetch_optional(&self.readers)
            .await?;
        row.as_ref().map(token).transpose()
    }

    /// All tokens, oldest first, each with the bytes that it keeps here.
    pub async fn tokens(&self) -> Result<Vec<(Token, u64)>, StoreError> {
        let rows = sqlx::query(
            "SELECT *, (SELECT coalesce(sum(size), 0) FROM holdings JOIN blobs USING (sha256)
                        WHERE token = tokens.id)
                    + (SELECT coalesce(sum(length), 0) FROM partials
                       WHERE token = tokens.id AND result IS NULL) AS bytes
             FROM tokens ORDER BY id",
        )
        .fetch_all(&self.readers)
        .await?;
        rows.iter().map(|row| Ok((token(row)?, number(row, "bytes")?))).collect()
    }

    /// Revokes a token, for ever. A second time changes nothing.
    ///
    /// # Errors
    /// [`StoreError::NotFound`].
    pub async fn revoke_token(&self, id: TokenId) -> Result<(), StoreError> {
        let changed =
            sqlx::query("UPDATE tokens SET revoked_at = coalesce(revoked_at, ?) WHERE id = ?")
                .bind(Timestamp::now().0)
                .bind(id.to_string())
                .execute(&self.writer)
                .await?;
        if changed.rows_affected() == 0 {
            return Err(StoreError::NotFound { what: "token", id: id.to_string() });
        }
        Ok(())
    }

    /// True if no token was ever made: everyone may do everything then. Revoking the last one does
    /// not open the service again.
    pub async fn is_open(&self) -> Result<bool, StoreError> {
        let row = sqlx::query("SELECT 1 FROM tokens LIMIT 1").fetch_optional(&self.readers).await?;
        Ok(row.is_none())
    }

    /// Bytes of uploads that a token keeps here, or has begun.
    pub async fn token_bytes(&self, id: TokenId) -> Result<u64, StoreError> {
        let row = sqlx::query(
            "SELECT (SELECT coalesce(sum(size), 0) FROM holdings JOIN blobs USING (sha256)
                     WHERE token = ?1)
                  + (SELECT coalesce(sum(length), 0) FROM partials
                     WHERE token = ?1 AND result IS NULL) AS bytes",
        )
        .bind(id.to_string())
        .fetch_one(&self.readers)
        .await?;
        number(&row, "bytes")
    }
}

fn token(row: &SqliteRow) -> Result<Token, StoreError> {
    Ok(Token {
        id: parsed(row, "id")?,
        lab: parsed(row, "lab")?,
        role: parsed(row, "role")?,
        note: parsed_if(row, "note")?,
        max_bytes: number_if(row, "max_bytes")?,
        created_at: Timestamp(row.try_get("created_at")?),
        revoked_at: row.try_get::<Option<i64>, _>("revoked_at")?.map(Timestamp),
    })
}
