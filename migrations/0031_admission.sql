-- Uploads that come in pieces (tus 1.0). The bytes lie in partial/ID; only the first `received` of
-- them are known to be on the disk.
CREATE TABLE partials (
    id         TEXT PRIMARY KEY,
    lab        TEXT NOT NULL,
    token      TEXT REFERENCES tokens (id),
    length     INTEGER NOT NULL CHECK (length > 0),
    received   INTEGER NOT NULL DEFAULT 0 CHECK (received BETWEEN 0 AND length),
    metadata   TEXT NOT NULL, -- as the client sent it
    expected   TEXT, -- SHA-256 that the client says the whole file has
    result     TEXT, -- SHA-256 of the stored file, once all is there
    expires_at INTEGER NOT NULL
) STRICT, WITHOUT ROWID;

CREATE INDEX partials_expiry ON partials (expires_at);

-- Bytes that a job's tiles and results may need, reserved until it has ended.
ALTER TABLE jobs ADD COLUMN disk_bytes INTEGER NOT NULL DEFAULT 0;
