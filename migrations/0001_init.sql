-- All moments are milliseconds since 1970-01-01T00:00:00Z; all identifiers are version 7 UUIDs as
-- text, so that they sort by time; all hashes are SHA-256 in lower-case hexadecimal digits.

-- Files of the content-addressed store. A row stands here exactly while its file is meant to be there.
CREATE TABLE blobs (
    sha256     TEXT PRIMARY KEY CHECK (length(sha256) = 64),
    size       INTEGER NOT NULL CHECK (size > 0),
    -- upload: sent by a user; prepared: derived from an upload; tile: the result of a task.
    origin     TEXT NOT NULL CHECK (origin IN ('upload', 'prepared', 'tile')),
    created_at INTEGER NOT NULL,
    -- When it was last sent or made: what nobody uses is kept for a time after this.
    touched_at INTEGER NOT NULL
) STRICT, WITHOUT ROWID;

CREATE TABLE calibrations (
    id                TEXT PRIMARY KEY,
    name              TEXT,
    masks             TEXT NOT NULL REFERENCES blobs (sha256),
    prepared          TEXT NOT NULL REFERENCES blobs (sha256),
    format            TEXT NOT NULL,
    sample            TEXT NOT NULL,
    frames            INTEGER NOT NULL CHECK (frames > 0),
    height            INTEGER NOT NULL CHECK (height > 0),
    width             INTEGER NOT NULL CHECK (width > 0),
    full_scale        REAL NOT NULL CHECK (full_scale > 0),
    mask_mean         REAL NOT NULL,
    dead_pixels       INTEGER NOT NULL,
    clipped_negatives INTEGER NOT NULL,
    created_at        INTEGER NOT NULL
) STRICT, WITHOUT ROWID;

CREATE INDEX calibrations_masks ON calibrations (masks);
CREATE INDEX calibrations_prepared ON calibrations (prepared);

CREATE TABLE measurements (
    id          TEXT PRIMARY KEY,
    name        TEXT,
    calibration TEXT NOT NULL REFERENCES calibrations (id),
    data        TEXT NOT NULL REFERENCES blobs (sha256),
    prepared    TEXT NOT NULL REFERENCES blobs (sha256),
    format      TEXT NOT NULL,
    sample      TEXT NOT NULL,
    snapshots   INTEGER NOT NULL CHECK (snapshots > 0),
    height      INTEGER NOT NULL,
    width       INTEGER NOT NULL,
    full_scale  REAL NOT NULL CHECK (full_scale > 0),
    camera_fps  REAL CHECK (camera_fps > 0),
    exposure_s  REAL CHECK (exposure_s > 0),
    created_at  INTEGER NOT NULL
) STRICT, WITHOUT ROWID;

CREATE INDEX measurements_calibration ON measurements (calibration);
CREATE INDEX measurements_data ON measurements (data);
CREATE INDEX measurements_prepared ON measurements (prepared);

CREATE TABLE jobs (
    id              TEXT PRIMARY KEY,
    calibration     TEXT NOT NULL REFERENCES calibrations (id),
    measurement     TEXT NOT NULL REFERENCES measurements (id),
    label           TEXT,
    spec            TEXT NOT NULL, -- JobSpec as JSON
    state           TEXT NOT NULL CHECK (state IN
                        ('queued', 'running', 'succeeded', 'failed', 'cancelling', 'cancelled')),
    priority        INTEGER NOT NULL,
    error           TEXT, -- why it failed
    idempotency_key TEXT UNIQUE,
    request         TEXT NOT NULL, -- hash of the request, to tell a repeated one from another one
    created_at      INTEGER NOT NULL,
    started_at      INTEGER,
    finished_at     INTEGER
) STRICT, WITHOUT ROWID;

CREATE INDEX jobs_state ON jobs (state);
CREATE INDEX jobs_calibration ON jobs (calibration);
CREATE INDEX jobs_measurement ON jobs (measurement);

CREATE TABLE tasks (
    id          TEXT PRIMARY KEY,
    job         TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    ordinal     INTEGER NOT NULL, -- the order in which the tasks of a job are handed out
    kind        TEXT NOT NULL CHECK (kind IN ('prepare', 'tile', 'assemble', 'manifest')),
    snapshot    INTEGER,
    tile        INTEGER,
    state       TEXT NOT NULL CHECK (state IN
                    ('blocked', 'ready', 'running', 'done', 'failed', 'cancelled')),
    priority    INTEGER NOT NULL, -- the job's
    cost        REAL NOT NULL CHECK (cost >= 0), -- planned CPU-seconds, as the weight of progress
    -- Of the attempt that runs or ran last:
    attempt     INTEGER NOT NULL DEFAULT 0, -- its number, from 1; also the fence against older ones
    worker      TEXT,
    lease_until INTEGER,
    stage       TEXT,
    iterations  INTEGER NOT NULL DEFAULT 0,
    passes      INTEGER NOT NULL DEFAULT 0,
    fraction    REAL NOT NULL DEFAULT 0, -- of the planned cost
    seconds     REAL, -- that the successful attempt took
    ready_at    INTEGER NOT NULL DEFAULT 0, -- not handed out before: the pause after a failure
    -- Of all attempts since the job was last (re)started:
    failures    INTEGER NOT NULL DEFAULT 0, -- errors that a worker told, and crashes
    losses      INTEGER NOT NULL DEFAULT 0, -- leases that ran out
    -- Of a task that is done:
    result      TEXT REFERENCES blobs (sha256), -- of a tile, until the job has succeeded
    record      TEXT, -- what the worker has to tell about it, as JSON
    UNIQUE (job, ordinal)
) STRICT, WITHOUT ROWID;

CREATE INDEX tasks_claim ON tasks (state, priority DESC, job, ordinal);
CREATE INDEX tasks_order ON tasks (job, kind, snapshot, state);
CREATE INDEX tasks_worker ON tasks (worker) WHERE state = 'running';
CREATE INDEX tasks_result ON tasks (result) WHERE result IS NOT NULL;

CREATE TABLE attempts (
    task       TEXT NOT NULL REFERENCES tasks (id) ON DELETE CASCADE,
    attempt    INTEGER NOT NULL,
    worker     TEXT NOT NULL,
    started_at INTEGER NOT NULL,
    ended_at   INTEGER,
    -- done, failed (the worker said so), crashed (the worker died of it), lost (the lease ran out),
    -- cancelled, released (given back unharmed)
    outcome    TEXT CHECK (outcome IN
                   ('done', 'failed', 'crashed', 'lost', 'cancelled', 'released')),
    reason     TEXT,
    PRIMARY KEY (task, attempt)
) STRICT, WITHOUT ROWID;

-- Files that a job has made, in the results folder. `snapshot` is -1 for those of the whole job.
CREATE TABLE result_files (
    job      TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    snapshot INTEGER NOT NULL,
    name     TEXT NOT NULL, -- path below the snapshot's folder, such as frames/frame_0001.exr
    size     INTEGER NOT NULL,
    sha256   TEXT NOT NULL,
    PRIMARY KEY (job, snapshot, name)
) STRICT, WITHOUT ROWID;

CREATE TABLE workers (
    id         TEXT PRIMARY KEY,
    pid        INTEGER NOT NULL,
    version    TEXT NOT NULL,
    started_at INTEGER NOT NULL,
    seen_at    INTEGER NOT NULL
) STRICT, WITHOUT ROWID;
