-- Access: who may come in, and whose the data are. What was stored before there were labs belongs
-- to the lab 'local', as does all that a service without tokens stores.

CREATE TABLE tokens (
    id         TEXT PRIMARY KEY,
    hash       TEXT NOT NULL UNIQUE CHECK (length(hash) = 64), -- SHA-256; the token is kept nowhere
    lab        TEXT NOT NULL,
    role       TEXT NOT NULL CHECK (role IN ('read', 'submit', 'admin')),
    note       TEXT, -- whom it was given to
    max_bytes  INTEGER CHECK (max_bytes >= 0), -- of uploads that it may keep here; none: no limit
    created_at INTEGER NOT NULL,
    revoked_at INTEGER
) STRICT, WITHOUT ROWID;

ALTER TABLE calibrations ADD COLUMN lab TEXT NOT NULL DEFAULT 'local';
ALTER TABLE measurements ADD COLUMN lab TEXT NOT NULL DEFAULT 'local';
ALTER TABLE jobs ADD COLUMN lab TEXT NOT NULL DEFAULT 'local';

CREATE INDEX calibrations_lab ON calibrations (lab, id);
CREATE INDEX measurements_lab ON measurements (lab, id);
CREATE INDEX jobs_lab ON jobs (lab, id);

-- Which lab has sent which file. Two labs that send the same file share its bytes, and neither can
-- tell: what a lab has not sent is not there for it.
CREATE TABLE holdings (
    lab        TEXT NOT NULL,
    sha256     TEXT NOT NULL REFERENCES blobs (sha256),
    token      TEXT REFERENCES tokens (id), -- whose limit it counts against
    created_at INTEGER NOT NULL,
    touched_at INTEGER NOT NULL, -- when it was last sent
    PRIMARY KEY (lab, sha256)
) STRICT, WITHOUT ROWID;

CREATE INDEX holdings_sha256 ON holdings (sha256);
CREATE INDEX holdings_token ON holdings (token) WHERE token IS NOT NULL;

INSERT INTO holdings (lab, sha256, token, created_at, touched_at)
    SELECT 'local', sha256, NULL, created_at, touched_at FROM blobs WHERE origin = 'upload';

-- A key is good for one job of a lab. The column has been unique over all jobs from the start, so
-- the lab's name, which has no space, stands before it.
UPDATE jobs SET idempotency_key = 'local ' || idempotency_key WHERE idempotency_key IS NOT NULL;
