-- The schema of version 0.1.0. Times are milliseconds since 1970, identifiers are UUIDs of version 7, and
-- `lab` names the owner of a row. Comments stand inside the statements, so that SQLite keeps them.

-- Folder, time and people --------------------------------------------------------------------------------

CREATE TABLE folder (
    -- Ties the database to its folder; see crates/store/src/identity.rs.
    one        INTEGER PRIMARY KEY CHECK (one = 1),
    id         TEXT NOT NULL,
    generation INTEGER NOT NULL -- only rises; 0 until the marker has been written
) STRICT;

CREATE TABLE clock (
    -- Times that the service has seen. After the clock was wrong for a while, a young file must not look old.
    run  INTEGER PRIMARY KEY, -- milliseconds for which the service has run
    wall INTEGER NOT NULL     -- the time of day at that moment
) STRICT;

CREATE TABLE labs (
    lab       TEXT PRIMARY KEY,
    share     REAL NOT NULL DEFAULT 1 CHECK (share > 0), -- weight of the lab beside the weights of others
    -- Tags of start-time fair queueing, in planned CPU-seconds divided by the share: of the task that was
    -- handed out last, its start and its end.
    start     REAL NOT NULL DEFAULT 0,
    finish    REAL NOT NULL DEFAULT 0,
    -- Limits; NULL for no limit.
    max_bytes INTEGER CHECK (max_bytes >= 0),
    max_jobs  INTEGER CHECK (max_jobs >= 0)
) STRICT, WITHOUT ROWID;

CREATE TABLE lab_totals (
    -- Counters that only grow, although jobs are deleted.
    lab          TEXT PRIMARY KEY,
    jobs_begun   INTEGER NOT NULL DEFAULT 0,
    wait_seconds REAL NOT NULL DEFAULT 0, -- of those jobs, from submission to the first task's start
    cpu_seconds  REAL NOT NULL DEFAULT 0  -- of tasks that are done
) STRICT, WITHOUT ROWID;

CREATE TABLE tokens (
    id         TEXT PRIMARY KEY,
    hash       TEXT NOT NULL UNIQUE CHECK (length(hash) = 64), -- SHA-256; the secret is not stored
    lab        TEXT NOT NULL,
    role       TEXT NOT NULL CHECK (role IN ('read', 'submit', 'admin')),
    all_labs   INTEGER NOT NULL DEFAULT 0 CHECK (all_labs IN (0, 1)), -- 1: valid for every lab
    note       TEXT, -- the person or machine that has it
    max_bytes  INTEGER CHECK (max_bytes >= 0), -- limit of its uploads and prepared arrays; NULL for none
    created_at INTEGER NOT NULL,
    expires_at INTEGER, -- NULL: never
    used_at    INTEGER, -- last use, to within a few minutes; NULL: never
    revoked_at INTEGER
) STRICT, WITHOUT ROWID;

CREATE TABLE sessions (
    -- A browser presents a session instead of a token. It ends with its token.
    hash       TEXT PRIMARY KEY CHECK (length(hash) = 64), -- SHA-256; the secret is not stored
    token      TEXT NOT NULL REFERENCES tokens (id) ON DELETE CASCADE,
    created_at INTEGER NOT NULL,
    expires_at INTEGER NOT NULL
) STRICT, WITHOUT ROWID;

CREATE INDEX sessions_token ON sessions (token, created_at);

-- Files --------------------------------------------------------------------------------------------------

CREATE TABLE blobs (
    sha256     TEXT PRIMARY KEY CHECK (length(sha256) = 64),
    size       INTEGER NOT NULL CHECK (size > 0),
    -- upload: sent by a user; prepared: derived from an upload; tile: the result of a task.
    origin     TEXT NOT NULL CHECK (origin IN ('upload', 'prepared', 'tile')),
    created_at INTEGER NOT NULL,
    touched_at INTEGER NOT NULL, -- last upload or production; unused files are kept for a time after it
    damaged_at INTEGER -- when the file was found missing or changed; NULL if it is believed sound
) STRICT, WITHOUT ROWID;

CREATE INDEX blobs_damaged ON blobs (sha256) WHERE damaged_at IS NOT NULL;

CREATE TABLE holdings (
    -- Uploads of each lab. Labs that send the same bytes share one file.
    lab        TEXT NOT NULL,
    sha256     TEXT NOT NULL REFERENCES blobs (sha256),
    token      TEXT REFERENCES tokens (id), -- its limit applies
    created_at INTEGER NOT NULL,
    touched_at INTEGER NOT NULL, -- last upload
    PRIMARY KEY (lab, sha256)
) STRICT, WITHOUT ROWID;

CREATE INDEX holdings_sha256 ON holdings (sha256);
CREATE INDEX holdings_token ON holdings (token) WHERE token IS NOT NULL;

CREATE TABLE partials (
    -- Resumable uploads.
    id         TEXT PRIMARY KEY,
    lab        TEXT NOT NULL,
    token      TEXT REFERENCES tokens (id),
    length     INTEGER NOT NULL CHECK (length > 0), -- bytes of the whole file
    received   INTEGER NOT NULL DEFAULT 0 CHECK (received BETWEEN 0 AND length),
    metadata   TEXT NOT NULL, -- as the client sent it
    expected   TEXT, -- SHA-256 that the client states for the whole file
    result     TEXT, -- SHA-256 of the stored file, once it is complete
    expires_at INTEGER NOT NULL
) STRICT, WITHOUT ROWID;

CREATE INDEX partials_expiry ON partials (expires_at);

CREATE TABLE scrub (
    -- Position of the slow verification of all stored files.
    one        INTEGER PRIMARY KEY CHECK (one = 1),
    started_at INTEGER NOT NULL,
    place      TEXT -- the file verified last, as JSON; NULL before the first and after the last
) STRICT;

CREATE TABLE request_keys (
    -- Idempotency keys: a request that is repeated with its key creates nothing new.
    lab     TEXT NOT NULL,
    what    TEXT NOT NULL CHECK (what IN
                ('calibration', 'job', 'measurement', 'model', 'upload')),
    key     TEXT NOT NULL,
    request TEXT NOT NULL, -- hash of the request, which distinguishes a repetition from another request
    id      TEXT NOT NULL, -- identifier of the created row
    PRIMARY KEY (lab, what, key)
) STRICT, WITHOUT ROWID;

CREATE INDEX request_keys_id ON request_keys (id);

-- Calibrations, measurements and models ------------------------------------------------------------------

CREATE TABLE calibration_requests (
    -- Every calibration from its request on. A task makes its masks and its report.
    calibration    TEXT PRIMARY KEY,
    lab            TEXT NOT NULL,
    token          TEXT REFERENCES tokens (id),
    name           TEXT,
    captures       TEXT, -- as JSON; NULL if masks were sent
    mosaic         TEXT CHECK (mosaic IN ('rggb', 'bggr', 'grbg', 'gbrg')),
    prepared_bytes INTEGER NOT NULL DEFAULT 0, -- of the masks that will be made from captures
    created_at     INTEGER NOT NULL
) STRICT, WITHOUT ROWID;

CREATE TABLE calibration_captures (
    -- Uploads that are needed until the masks are made.
    calibration TEXT NOT NULL REFERENCES calibration_requests (calibration) ON DELETE CASCADE,
    sha256      TEXT NOT NULL REFERENCES blobs (sha256),
    PRIMARY KEY (calibration, sha256)
) STRICT, WITHOUT ROWID;

CREATE INDEX calibration_captures_blob ON calibration_captures (sha256);

CREATE TABLE calibrations (
    -- Calibrations with masks.
    id                TEXT PRIMARY KEY,
    lab               TEXT NOT NULL,
    token             TEXT REFERENCES tokens (id), -- its limit applies to the prepared array
    name              TEXT,
    masks             TEXT NOT NULL REFERENCES blobs (sha256),
    prepared          TEXT NOT NULL REFERENCES blobs (sha256),
    format            TEXT NOT NULL,
    sample            TEXT NOT NULL,
    axes              TEXT, -- order of the axes of an uploaded array; NULL for pictures
    frames            INTEGER NOT NULL CHECK (frames > 0),
    height            INTEGER NOT NULL CHECK (height > 0),
    width             INTEGER NOT NULL CHECK (width > 0),
    full_scale        REAL NOT NULL CHECK (full_scale > 0),
    mask_mean         REAL NOT NULL,
    dead_pixels       INTEGER NOT NULL,
    clipped_negatives INTEGER NOT NULL,
    -- The colours of a cell of 2x2 pixels, row by row; NULL for a grey sensor.
    mosaic            TEXT CHECK (mosaic IN ('rggb', 'bggr', 'grbg', 'gbrg')),
    created_at        INTEGER NOT NULL
) STRICT, WITHOUT ROWID;

CREATE INDEX calibrations_lab ON calibrations (lab, id);
CREATE INDEX calibrations_masks ON calibrations (masks);
CREATE INDEX calibrations_prepared ON calibrations (prepared);

CREATE TABLE calibration_reports (
    calibration TEXT PRIMARY KEY REFERENCES calibrations (id) ON DELETE CASCADE,
    report      TEXT NOT NULL -- as JSON
) STRICT, WITHOUT ROWID;

CREATE TABLE calibration_maps (
    -- Pictures of a report. A table with row numbers, since its rows are large.
    calibration TEXT NOT NULL REFERENCES calibrations (id) ON DELETE CASCADE,
    name        TEXT NOT NULL,
    png         BLOB NOT NULL,
    PRIMARY KEY (calibration, name)
) STRICT;

CREATE TABLE measurements (
    id          TEXT PRIMARY KEY,
    lab         TEXT NOT NULL,
    token       TEXT REFERENCES tokens (id), -- its limit applies to the prepared array
    name        TEXT,
    calibration TEXT NOT NULL REFERENCES calibrations (id),
    data        TEXT NOT NULL REFERENCES blobs (sha256),
    prepared    TEXT NOT NULL REFERENCES blobs (sha256),
    format      TEXT NOT NULL,
    sample      TEXT NOT NULL,
    axes        TEXT, -- order of the axes of an uploaded array; NULL for pictures
    snapshots   INTEGER NOT NULL CHECK (snapshots > 0),
    height      INTEGER NOT NULL,
    width       INTEGER NOT NULL,
    full_scale  REAL NOT NULL CHECK (full_scale > 0),
    camera_fps  REAL CHECK (camera_fps > 0),
    exposure_s  REAL CHECK (exposure_s > 0),
    -- contiguous: the snapshots follow one another without a gap.
    sequence    TEXT NOT NULL CHECK (sequence IN ('contiguous', 'separate')),
    dark        TEXT, -- uploads that were subtracted, as JSON
    warnings    TEXT, -- findings of the check, as JSON
    created_at  INTEGER NOT NULL
) STRICT, WITHOUT ROWID;

CREATE INDEX measurements_lab ON measurements (lab, id);
CREATE INDEX measurements_calibration ON measurements (calibration);
CREATE INDEX measurements_data ON measurements (data);
CREATE INDEX measurements_prepared ON measurements (prepared);

CREATE TABLE checks (
    -- Calibrations of ready masks, and measurements, while their check goes on and after it failed. A check
    -- that has passed is replaced by the row of its calibration or measurement.
    id          TEXT PRIMARY KEY, -- of the calibration or measurement
    what        TEXT NOT NULL CHECK (what IN ('calibration', 'measurement')),
    lab         TEXT NOT NULL,
    token       TEXT REFERENCES tokens (id),
    name        TEXT,
    calibration TEXT, -- that of a measurement
    request     TEXT NOT NULL, -- as JSON
    begun       INTEGER NOT NULL DEFAULT 1, -- attempts; bounded, as a check may be what ended the service
    problem     TEXT, -- the reason of a failure, as JSON
    created_at  INTEGER NOT NULL
) STRICT, WITHOUT ROWID;

CREATE INDEX checks_lab ON checks (lab, what, id);
CREATE INDEX checks_calibration ON checks (calibration) WHERE calibration IS NOT NULL;

CREATE TABLE check_files (
    -- Uploads that are being checked.
    id     TEXT NOT NULL REFERENCES checks (id) ON DELETE CASCADE,
    sha256 TEXT NOT NULL REFERENCES blobs (sha256),
    PRIMARY KEY (id, sha256)
) STRICT, WITHOUT ROWID;

CREATE INDEX check_files_sha256 ON check_files (sha256);

CREATE TABLE models (
    id          TEXT PRIMARY KEY,
    lab         TEXT NOT NULL,
    name        TEXT,
    calibration TEXT NOT NULL REFERENCES calibrations (id),
    file        TEXT NOT NULL REFERENCES blobs (sha256), -- the ONNX file
    facts       TEXT NOT NULL, -- results of its check, as JSON
    created_at  INTEGER NOT NULL
) STRICT, WITHOUT ROWID;

CREATE INDEX models_lab ON models (lab, id);
CREATE INDEX models_calibration ON models (calibration);
CREATE INDEX models_file ON models (file);

-- Jobs and their tasks -----------------------------------------------------------------------------------

CREATE TABLE jobs (
    id           TEXT PRIMARY KEY,
    lab          TEXT NOT NULL,
    calibration  TEXT NOT NULL REFERENCES calibrations (id),
    measurement  TEXT NOT NULL REFERENCES measurements (id),
    model        TEXT REFERENCES models (id),
    label        TEXT,
    spec         TEXT NOT NULL, -- JobSpec as JSON
    state        TEXT NOT NULL CHECK (state IN
                      ('queued', 'running', 'succeeded', 'failed', 'cancelling', 'cancelled')),
    priority     INTEGER NOT NULL,
    error        TEXT, -- the reason of a failure
    disk_bytes   INTEGER NOT NULL, -- reserved for its results until it ends
    result_bytes INTEGER NOT NULL DEFAULT 0, -- sum over its result files
    assessment   TEXT, -- expected quality, as JSON; NULL until it is known
    created_at   INTEGER NOT NULL,
    started_at   INTEGER, -- first claim of a task
    finished_at  INTEGER
) STRICT, WITHOUT ROWID;

CREATE INDEX jobs_lab ON jobs (lab, id);
CREATE INDEX jobs_state ON jobs (state);
CREATE INDEX jobs_unfinished ON jobs (id) WHERE finished_at IS NULL;
CREATE INDEX jobs_figures ON jobs (lab, state, result_bytes);
CREATE INDEX jobs_calibration ON jobs (calibration);
CREATE INDEX jobs_measurement ON jobs (measurement);
CREATE INDEX jobs_model ON jobs (model);

CREATE TABLE job_sums (
    -- Sums over the tasks of a job, written whenever a task ends.
    job            TEXT PRIMARY KEY REFERENCES jobs (id) ON DELETE CASCADE,
    -- Planned CPU-seconds: of all tasks, of the remaining ones, and of the longest remaining one.
    cost           REAL NOT NULL,
    tiles_left     REAL NOT NULL,
    tiles_longest  REAL NOT NULL,
    others_left    REAL NOT NULL,
    others_longest REAL NOT NULL,
    tiles_total    INTEGER NOT NULL,
    tiles_done     INTEGER NOT NULL,
    tile_seconds   REAL NOT NULL, -- duration of the tiles that are done
    tile_cost      REAL NOT NULL, -- planned CPU-seconds of the tiles that are done
    prepared       INTEGER NOT NULL,
    previews_done  INTEGER NOT NULL,
    snapshots_done INTEGER NOT NULL,
    iterations     INTEGER NOT NULL, -- of tasks that are done
    passes         INTEGER NOT NULL
) STRICT, WITHOUT ROWID;

CREATE TABLE tasks (
    id          TEXT PRIMARY KEY,
    -- The owner: one of these three.
    job         TEXT REFERENCES jobs (id) ON DELETE CASCADE,
    calibration TEXT REFERENCES calibration_requests (calibration) ON DELETE CASCADE,
    movie       TEXT REFERENCES jobs (id) ON DELETE CASCADE, -- the job that the movie shows
    lab         TEXT NOT NULL,
    ordinal     INTEGER NOT NULL, -- order in which the tasks of a job are handed out
    kind        TEXT NOT NULL CHECK (kind IN ('prepare', 'preview', 'pilot', 'tile', 'assemble',
                    'manifest', 'calibration', 'movie')),
    snapshot    INTEGER, -- NULL for the movie of all snapshots
    -- Number of snapshots that a tile reconstructs together, from `snapshot` on.
    snapshots   INTEGER NOT NULL DEFAULT 1 CHECK (snapshots > 0),
    tile        INTEGER,
    state       TEXT NOT NULL CHECK (state IN
                    ('blocked', 'ready', 'running', 'done', 'failed', 'cancelled')),
    priority    INTEGER NOT NULL, -- the job's; higher for a calibration, lower for a movie
    cost        REAL NOT NULL CHECK (cost >= 0), -- planned CPU-seconds, the weight of progress
    -- Of the last attempt:
    attempt     INTEGER NOT NULL DEFAULT 0, -- its number from 1, which fences off earlier attempts
    worker      TEXT, -- NULL unless it runs
    lease_until INTEGER,
    stage       TEXT,
    iterations  INTEGER NOT NULL DEFAULT 0,
    passes      INTEGER NOT NULL DEFAULT 0,
    fraction    REAL NOT NULL DEFAULT 0, -- of the planned cost
    seconds     REAL, -- duration of the successful attempt
    ready_at    INTEGER NOT NULL DEFAULT 0, -- end of the pause after a failure
    -- Of all attempts since the job was last started or retried:
    failures    INTEGER NOT NULL DEFAULT 0, -- reported errors, and crashes
    losses      INTEGER NOT NULL DEFAULT 0, -- expired leases, and killed workers
    starved     INTEGER NOT NULL DEFAULT 0, -- workers that the kernel killed for lack of memory
    -- Of a task that is done:
    result      TEXT REFERENCES blobs (sha256), -- of a movie; of a tile or preview until the job succeeds
    record      TEXT, -- report of the worker, as JSON
    history     TEXT, -- course of the solver: [[iteration, residual, change, sigma], ...]
    UNIQUE (job, ordinal),
    CHECK ((job IS NULL) = (kind IN ('calibration', 'movie'))),
    CHECK ((calibration IS NULL) = (kind <> 'calibration')),
    CHECK ((movie IS NULL) = (kind <> 'movie'))
) STRICT, WITHOUT ROWID;

CREATE INDEX tasks_order ON tasks (job, kind, snapshot, state);
CREATE UNIQUE INDEX tasks_calibration ON tasks (calibration) WHERE calibration IS NOT NULL;
CREATE UNIQUE INDEX tasks_movie ON tasks (movie, coalesce(snapshot, -1)) WHERE movie IS NOT NULL;
CREATE INDEX tasks_movies_of_lab ON tasks (lab) WHERE movie IS NOT NULL;
CREATE INDEX tasks_worker ON tasks (worker) WHERE worker IS NOT NULL;
CREATE INDEX tasks_result ON tasks (result) WHERE result IS NOT NULL;
CREATE INDEX tasks_claim ON tasks (state, lab, priority DESC, job, ordinal);
CREATE INDEX tasks_ready ON tasks (job, ordinal) WHERE state = 'ready';
CREATE INDEX tasks_others ON tasks (lab, priority DESC, job, ordinal)
    WHERE state = 'ready' AND kind <> 'tile';
CREATE INDEX tasks_others_of_job ON tasks (job, ordinal) WHERE state = 'ready' AND kind <> 'tile';

CREATE TABLE attempts (
    task       TEXT NOT NULL REFERENCES tasks (id) ON DELETE CASCADE,
    attempt    INTEGER NOT NULL,
    worker     TEXT NOT NULL,
    started_at INTEGER NOT NULL,
    ended_at   INTEGER,
    -- failed: the worker reported an error; crashed: the worker died of a fault; lost: the lease expired or
    -- the worker was killed; released: the task was given back unharmed.
    outcome    TEXT CHECK (outcome IN
                   ('done', 'failed', 'crashed', 'lost', 'cancelled', 'released')),
    reason     TEXT,
    PRIMARY KEY (task, attempt)
) STRICT, WITHOUT ROWID;

CREATE TABLE remote_tasks (
    -- Tiles that are out with workers on other machines. Their leases don't expire: the hub watches the
    -- workers.
    task     TEXT PRIMARY KEY REFERENCES tasks (id) ON DELETE CASCADE,
    pool     TEXT NOT NULL, -- the workers that may have it
    attempt  INTEGER NOT NULL, -- that of the message; `tasks` counts on when the message is redelivered
    -- Where the message is; NULL until it is published.
    stream   TEXT, -- the stream, by the time of its creation
    seq      INTEGER, -- its number in the stream
    delivery INTEGER NOT NULL DEFAULT 0 -- the last delivery that a worker has begun with; 0 for none
) STRICT, WITHOUT ROWID;

CREATE INDEX remote_tasks_pool ON remote_tasks (pool);

CREATE TABLE result_files (
    job        TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    snapshot   INTEGER NOT NULL, -- -1 for files of the whole job
    name       TEXT NOT NULL, -- path below the snapshot's folder, such as frames/frame_0001.exr
    size       INTEGER NOT NULL,
    sha256     TEXT NOT NULL,
    damaged_at INTEGER, -- when the file was found missing or changed; NULL if it is believed sound
    PRIMARY KEY (job, snapshot, name)
) STRICT, WITHOUT ROWID;

CREATE INDEX result_files_damaged ON result_files (job, snapshot) WHERE damaged_at IS NOT NULL;

CREATE TABLE workers (
    id         TEXT PRIMARY KEY,
    pid        INTEGER NOT NULL,
    version    TEXT NOT NULL,
    -- Of workers on other machines:
    host       TEXT,
    pool       TEXT,
    device     TEXT,
    started_at INTEGER NOT NULL,
    seen_at    INTEGER NOT NULL
) STRICT, WITHOUT ROWID;

CREATE TABLE totals (
    -- Counters by kind of task that only grow, although jobs are deleted.
    kind           TEXT PRIMARY KEY,
    tasks          INTEGER NOT NULL,
    seconds        REAL NOT NULL,
    iterations     INTEGER NOT NULL,
    passes         INTEGER NOT NULL,
    -- Fading sums over the last tasks: duration, and planned CPU-seconds that were really used.
    recent_seconds REAL NOT NULL DEFAULT 0,
    recent_cost    REAL NOT NULL DEFAULT 0
) STRICT, WITHOUT ROWID;

-- What follows from a change -----------------------------------------------------------------------------

CREATE TRIGGER remote_tasks_end AFTER UPDATE OF state ON tasks
    WHEN OLD.state = 'running' AND NEW.state <> 'running'
BEGIN
    DELETE FROM remote_tasks WHERE task = NEW.id;
END;

CREATE TRIGGER result_files_add AFTER INSERT ON result_files
BEGIN
    UPDATE jobs SET result_bytes = result_bytes + NEW.size WHERE id = NEW.job;
END;

CREATE TRIGGER result_files_change AFTER UPDATE OF size ON result_files
BEGIN
    UPDATE jobs SET result_bytes = result_bytes + NEW.size - OLD.size WHERE id = NEW.job;
END;

CREATE TRIGGER result_files_remove AFTER DELETE ON result_files
BEGIN
    UPDATE jobs SET result_bytes = result_bytes - OLD.size WHERE id = OLD.job;
END;

-- A key lives as long as the row that its request created, or will create.
CREATE TRIGGER calibration_keys_end AFTER DELETE ON calibration_requests
BEGIN
    DELETE FROM request_keys WHERE id = OLD.calibration;
END;

CREATE TRIGGER measurement_keys_end AFTER DELETE ON measurements
BEGIN
    DELETE FROM request_keys WHERE id = OLD.id;
END;

CREATE TRIGGER model_keys_end AFTER DELETE ON models
BEGIN
    DELETE FROM request_keys WHERE id = OLD.id;
END;

CREATE TRIGGER job_keys_end AFTER DELETE ON jobs
BEGIN
    DELETE FROM request_keys WHERE id = OLD.id;
END;

CREATE TRIGGER upload_keys_end AFTER DELETE ON partials
BEGIN
    DELETE FROM request_keys WHERE id = OLD.id;
END;

CREATE TRIGGER check_keys_end AFTER DELETE ON checks
    WHEN NOT EXISTS (SELECT 1 FROM calibration_requests WHERE calibration = OLD.id)
        AND NOT EXISTS (SELECT 1 FROM measurements WHERE id = OLD.id)
BEGIN
    DELETE FROM request_keys WHERE id = OLD.id;
END;
