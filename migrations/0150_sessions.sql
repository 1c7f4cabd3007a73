-- Tokens of those who look after all labs; of a limited life; and when each was last used.
ALTER TABLE tokens ADD COLUMN all_labs INTEGER NOT NULL DEFAULT 0 CHECK (all_labs IN (0, 1));
ALTER TABLE tokens ADD COLUMN expires_at INTEGER; -- NULL: never
ALTER TABLE tokens ADD COLUMN used_at INTEGER; -- to within a few minutes; NULL: never

-- What a browser shows instead of a token. A session is worth nothing when its token is not any more.
CREATE TABLE sessions (
    hash       TEXT PRIMARY KEY CHECK (length(hash) = 64), -- SHA-256; the secret is kept nowhere
    token      TEXT NOT NULL REFERENCES tokens (id) ON DELETE CASCADE,
    created_at INTEGER NOT NULL,
    expires_at INTEGER NOT NULL
) STRICT, WITHOUT ROWID;

CREATE INDEX sessions_token ON sessions (token, created_at);
