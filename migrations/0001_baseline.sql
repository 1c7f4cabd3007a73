-- The schema of version 0.1.0.

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
    -- Limits; NULL for the default.
    max_bytes INTEGER CHECK (max_bytes >= 0),
    max_jobs  INTEGER CHECK (max_jobs >= 0)
) STRICT, WITHOUT ROWID;

CREATE TABLE default_limits (
    -- Limits of labs whose own limits are NULL, if there are several labs. The service sets them at its start.
    one       INTEGER PRIMARY KEY CHECK (one = 1),
    max_bytes INTEGER NOT NULL,
    max_jobs  INTEGER NOT NULL
) STRICT;

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

CREATE TABLE blobs (
    sha256     TEXT PRIMARY KEY CHECK (length(sha256) = 64),
    size       INTEGER NOT NULL CHECK (size > 0),
    -- upload: sent by a user; prepared: derived from an upload; tile: the result of a task.
    origin     TEXT NOT NULL CHECK (origin IN ('upload', 'prepared', 'tile')),
    created_at INTEGER NOT NULL,
    touched_at INTEGER NOT NULL, -- last upload or production; unused files are kept for a time after it
    damaged_at INTEGER -- when the file was found missing or changed; NULL if it is believed sound
) STRICT, WITHOUT ROWID;

CREATE TABLE stored_files (
    -- Running totals of `blobs`.
    one   INTEGER PRIMARY KEY CHECK (one = 1),
    files INTEGER NOT NULL,
    bytes INTEGER NOT NULL
) STRICT;

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

CREATE TABLE files_of_labs (
    -- Running totals of the files of each lab. A file that several of its things use counts once.
    lab   TEXT NOT NULL,
    kind  TEXT NOT NULL CHECK (kind IN ('upload', 'prepared', 'movie')),
    files INTEGER NOT NULL,
    bytes INTEGER NOT NULL,
    PRIMARY KEY (lab, kind)
) STRICT, WITHOUT ROWID;

CREATE INDEX holdings_list ON holdings (lab, created_at, sha256);
CREATE INDEX holdings_sha256 ON holdings (sha256);
CREATE INDEX holdings_token ON holdings (token) WHERE token IS NOT NULL;

CREATE TABLE partials (
    -- Resumable uploads.
    id         TEXT PRIMARY KEY,
    lab        TEXT NOT NULL,
    token      TEXT REFERENCES tokens (id),
    length     INTEGER CHECK (length > 0), -- bytes of the whole file; NULL until the client states them
    received   INTEGER NOT NULL DEFAULT 0 CHECK (received BETWEEN 0 AND length),
    metadata   TEXT NOT NULL, -- as the client sent it
    expected   TEXT, -- SHA-256 that the client states for the whole file
    result     TEXT, -- SHA-256 of the stored file, once it is complete
    expires_at INTEGER NOT NULL
) STRICT, WITHOUT ROWID;

CREATE INDEX partials_expiry ON partials (expires_at);
CREATE INDEX partials_open ON partials (lab) WHERE result IS NULL;

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

CREATE TABLE requests (
    -- Calibrations, measurements and models, as labs asked for them.
    id             TEXT PRIMARY KEY,
    what           TEXT NOT NULL,    -- 'calibration', 'measurement' or 'model'
    lab            TEXT NOT NULL,
    token          TEXT REFERENCES tokens (id), -- its limit applies to the prepared array
    name           TEXT,
    calibration    TEXT,             -- that of a measurement or a model
    request        TEXT NOT NULL,    -- as JSON
    limits         TEXT NOT NULL,    -- of its check, as JSON
    prepared_bytes INTEGER NOT NULL DEFAULT 0, -- promised on the disk for what is being made
    origin         TEXT,             -- identifier of the HTTP request
    refusal        TEXT,             -- why nothing is made, as JSON
    created_at     INTEGER NOT NULL,
    -- Set when it is ready:
    prepared       TEXT REFERENCES blobs (sha256), -- the array that jobs read; of a model, its file
    facts          TEXT, -- as JSON
    CHECK ((prepared IS NULL) = (facts IS NULL))
) STRICT, WITHOUT ROWID;

CREATE INDEX requests_lab ON requests (lab, what, id);
CREATE INDEX requests_promised ON requests (lab) WHERE prepared_bytes > 0;
CREATE INDEX requests_calibration ON requests (calibration, what) WHERE calibration IS NOT NULL;
CREATE INDEX requests_prepared ON requests (prepared) WHERE prepared IS NOT NULL;

CREATE TABLE request_files (
    -- The uploads that a request needs. Once it is ready, only the one that it was made from.
    id     TEXT NOT NULL REFERENCES requests (id) ON DELETE CASCADE,
    sha256 TEXT NOT NULL REFERENCES blobs (sha256),
    PRIMARY KEY (id, sha256)
) STRICT, WITHOUT ROWID;

CREATE INDEX request_files_sha256 ON request_files (sha256);

CREATE TABLE calibration_reports (
    calibration TEXT PRIMARY KEY REFERENCES requests (id) ON DELETE CASCADE,
    report      TEXT NOT NULL -- as JSON
) STRICT, WITHOUT ROWID;

CREATE TABLE calibration_maps (
    -- Pictures of a report. A table with row numbers, since its rows are large.
    calibration TEXT NOT NULL REFERENCES requests (id) ON DELETE CASCADE,
    name        TEXT NOT NULL,
    png         BLOB NOT NULL,
    PRIMARY KEY (calibration, name)
) STRICT;

CREATE TABLE jobs (
    -- A table with row numbers, since its rows are large.
    id           TEXT PRIMARY KEY,
    lab          TEXT NOT NULL,
    calibration  TEXT NOT NULL REFERENCES requests (id),
    measurement  TEXT NOT NULL REFERENCES requests (id),
    model        TEXT REFERENCES requests (id),
    truth        TEXT REFERENCES blobs (sha256), -- the true frames, if they are known
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
) STRICT;

-- Hold all columns by which lists are filtered, so that a list reads few rows of the table.
CREATE INDEX jobs_of_lab ON jobs (lab, id, state, calibration, measurement, label, created_at);
CREATE INDEX jobs_in_state ON jobs (lab, state, id);
CREATE INDEX jobs_of_all ON jobs (id, state, calibration, measurement, label, created_at);
-- Finds the job of a lab whose task is next.
CREATE INDEX jobs_state ON jobs (state, lab, priority DESC, id);
-- Covers the forecast of the queue, which reads all unfinished jobs.
CREATE INDEX jobs_unfinished ON jobs (id, lab, priority, state, finished_at) WHERE finished_at IS NULL;
CREATE INDEX jobs_waiting ON jobs (lab, created_at) WHERE finished_at IS NULL AND started_at IS NULL;
CREATE INDEX jobs_finished ON jobs (finished_at, id) WHERE finished_at IS NOT NULL;
CREATE INDEX jobs_calibration ON jobs (calibration);
CREATE INDEX jobs_measurement ON jobs (measurement);
CREATE INDEX jobs_model ON jobs (model);
CREATE INDEX jobs_truth ON jobs (truth) WHERE truth IS NOT NULL;

CREATE TABLE notifications (
    -- Unsent notifications of jobs that have ended.
    id       INTEGER PRIMARY KEY AUTOINCREMENT,
    job      TEXT NOT NULL UNIQUE REFERENCES jobs (id) ON DELETE CASCADE,
    attempts INTEGER NOT NULL DEFAULT 0,
    next_at  INTEGER, -- time of the next attempt; NULL if it was given up
    error    TEXT -- why the last attempt failed
) STRICT;

CREATE INDEX notifications_due ON notifications (next_at) WHERE next_at IS NOT NULL;

CREATE TABLE webhook_secrets (
    -- Keys that sign the notifications of each lab. Receivers have a copy.
    lab    TEXT PRIMARY KEY,
    secret BLOB NOT NULL CHECK (length(secret) = 32)
) STRICT, WITHOUT ROWID;

CREATE TABLE removals (
    -- Files whose rows are deleted, until the files are removed. A start after a kill continues with them.
    kind       TEXT NOT NULL CHECK (kind IN ('blob', 'results')),
    id         TEXT NOT NULL, -- SHA-256 of the blob, or the job
    created_at INTEGER, -- of the deleted row; NULL where the time of the file counts
    PRIMARY KEY (kind, id)
) STRICT, WITHOUT ROWID;

CREATE TABLE jobs_by_state (
    -- Running totals of `jobs`: figures cost the same for any number of jobs.
    lab          TEXT NOT NULL,
    state        TEXT NOT NULL,
    jobs         INTEGER NOT NULL,
    disk_bytes   INTEGER NOT NULL,
    result_bytes INTEGER NOT NULL,
    PRIMARY KEY (lab, state)
) STRICT, WITHOUT ROWID;

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
    crc32      INTEGER NOT NULL, -- by which archives check the file
    derived    INTEGER NOT NULL, -- 1 for a file that is not on the disk, but composed of others when it is read
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
    seen_at    INTEGER NOT NULL,
    light      INTEGER NOT NULL DEFAULT 0, -- 1 if it takes short tasks only
    tiles      INTEGER NOT NULL DEFAULT 1  -- 1 if it takes tiles
) STRICT, WITHOUT ROWID;

CREATE TABLE tile_workers (
    -- Last sign of life of a worker that takes tiles, among those that are no longer in `workers`.
    one     INTEGER PRIMARY KEY CHECK (one = 1),
    seen_at INTEGER NOT NULL
) STRICT;

CREATE TABLE totals (
    -- Counters by kind of task that only grow, although jobs are deleted.
    kind           TEXT PRIMARY KEY,
    tasks          INTEGER NOT NULL,
    seconds        REAL NOT NULL,
    iterations     INTEGER NOT NULL,
    passes         INTEGER NOT NULL,
    -- Fading sums over the last tasks: duration, and planned CPU-seconds that were really used.
    recent_seconds REAL NOT NULL DEFAULT 0,
    recent_cost    REAL NOT NULL DEFAULT 0,
    onnxruntime    TEXT -- its version, as reported with the last task that used it
) STRICT, WITHOUT ROWID;

CREATE TABLE tasks (
    id          TEXT PRIMARY KEY,
    -- It is a part of this job, or makes something for this calibration, measurement, model or job:
    job         TEXT REFERENCES jobs (id) ON DELETE CASCADE,
    thing       TEXT,
    lab         TEXT NOT NULL DEFAULT 'local',
    ordinal     INTEGER NOT NULL, -- the order in which the tasks of a job, or of a thing, are handed out
    kind        TEXT NOT NULL,
    light       INTEGER NOT NULL DEFAULT 0, -- 1 if the light worker may take it
    snapshot    INTEGER, -- NULL for the movie of all snapshots
    snapshots   INTEGER NOT NULL DEFAULT 1 CHECK (snapshots > 0),
    tile        INTEGER,
    state       TEXT NOT NULL CHECK (state IN
                    ('blocked', 'ready', 'running', 'done', 'failed', 'cancelled')),
    priority    INTEGER NOT NULL,
    cost        REAL NOT NULL CHECK (cost >= 0), -- planned CPU-seconds, as the weight of progress
    -- The attempt that runs or ran last:
    attempt     INTEGER NOT NULL DEFAULT 0, -- number from 1; the fence against older ones
    worker      TEXT, -- of the attempt that runs
    lease_until INTEGER,
    stage       TEXT,
    iterations  INTEGER NOT NULL DEFAULT 0,
    passes      INTEGER NOT NULL DEFAULT 0,
    fraction    REAL NOT NULL DEFAULT 0, -- of the planned cost
    seconds     REAL, -- that the successful attempt took
    ready_at    INTEGER NOT NULL DEFAULT 0, -- not handed out before: the pause after a failure
    -- Counts over all attempts since the job was last (re)started:
    failures    INTEGER NOT NULL DEFAULT 0, -- errors that a worker reported, and crashes
    losses      INTEGER NOT NULL DEFAULT 0, -- leases that ran out
    starved     INTEGER NOT NULL DEFAULT 0, -- deaths for want of memory
    -- Set when the task is done:
    result      TEXT REFERENCES blobs (sha256), -- of a tile or preview, until the job has succeeded; of a movie
    record      TEXT, -- what the worker has to report about it, as JSON
    history     TEXT, -- how the solver went: [iteration, residual, change, sigma] as JSON
    CHECK ((job IS NULL) <> (thing IS NULL))
) STRICT, WITHOUT ROWID;

CREATE TABLE tasks_by_state (
    -- Running totals of `tasks`.
    kind  TEXT NOT NULL,
    state TEXT NOT NULL,
    tasks INTEGER NOT NULL,
    PRIMARY KEY (kind, state)
) STRICT, WITHOUT ROWID;

CREATE TABLE changes (
    -- The last changes of jobs, calibrations, measurements and models, for listeners.
    number INTEGER PRIMARY KEY,
    what   TEXT NOT NULL, -- as in `request_keys`
    lab    TEXT NOT NULL,
    id     TEXT NOT NULL
) STRICT;

CREATE INDEX tasks_order ON tasks (job, kind, snapshot, state);
CREATE UNIQUE INDEX tasks_thing ON tasks (thing, kind, coalesce(snapshot, -1)) WHERE thing IS NOT NULL;
CREATE INDEX tasks_checks ON tasks (lab) WHERE kind = 'check' AND state IN ('ready', 'running');
CREATE INDEX tasks_worker ON tasks (worker) WHERE worker IS NOT NULL;
CREATE INDEX tasks_result ON tasks (result) WHERE result IS NOT NULL;
CREATE INDEX tasks_running ON tasks (job) WHERE state = 'running';
-- Each claimant has two: by lab, and by job. They hold no other tasks than those that it may take.
CREATE INDEX tasks_ready ON tasks (lab, priority DESC, job, ordinal) WHERE state = 'ready';
CREATE INDEX tasks_ready_of_job ON tasks (job, ordinal) WHERE state = 'ready';
CREATE INDEX tasks_tiles ON tasks (lab, priority DESC, job, ordinal) WHERE state = 'ready' AND kind = 'tile';
CREATE INDEX tasks_tiles_of_job ON tasks (job, ordinal) WHERE state = 'ready' AND kind = 'tile';
CREATE INDEX tasks_others ON tasks (lab, priority DESC, job, ordinal) WHERE state = 'ready' AND kind <> 'tile';
CREATE INDEX tasks_others_of_job ON tasks (job, ordinal) WHERE state = 'ready' AND kind <> 'tile';
CREATE INDEX tasks_light ON tasks (lab, priority DESC, ordinal) WHERE state = 'ready' AND light = 1 AND job IS NULL;
CREATE INDEX tasks_light_of_job ON tasks (job, ordinal)
    WHERE state = 'ready' AND light = 1 AND job IS NOT NULL;

-- Derived files take no room.
CREATE TRIGGER result_files_add AFTER INSERT ON result_files
    WHEN NOT NEW.derived
BEGIN
    UPDATE jobs SET result_bytes = result_bytes + NEW.size WHERE id = NEW.job;
END;

CREATE TRIGGER result_files_change AFTER UPDATE OF size ON result_files
    WHEN NOT NEW.derived
BEGIN
    UPDATE jobs SET result_bytes = result_bytes + NEW.size - OLD.size WHERE id = NEW.job;
END;

CREATE TRIGGER result_files_remove AFTER DELETE ON result_files
    WHEN NOT OLD.derived
BEGIN
    UPDATE jobs SET result_bytes = result_bytes - OLD.size WHERE id = OLD.job;
END;

CREATE TRIGGER tile_workers_end AFTER DELETE ON workers
    WHEN OLD.tiles = 1
BEGIN
    INSERT INTO tile_workers VALUES (1, OLD.seen_at)
    ON CONFLICT (one) DO UPDATE SET seen_at = max(seen_at, excluded.seen_at);
END;

CREATE TRIGGER stored_files_add AFTER INSERT ON blobs
BEGIN
    INSERT INTO stored_files VALUES (1, 1, NEW.size)
    ON CONFLICT (one) DO UPDATE SET files = files + 1, bytes = bytes + NEW.size;
END;

CREATE TRIGGER stored_files_remove AFTER DELETE ON blobs
BEGIN
    UPDATE stored_files SET files = files - 1, bytes = bytes - OLD.size;
END;

CREATE TRIGGER uploads_add AFTER INSERT ON holdings
BEGIN
    INSERT INTO files_of_labs SELECT NEW.lab, 'upload', 1, size FROM blobs WHERE sha256 = NEW.sha256
    ON CONFLICT (lab, kind) DO UPDATE SET files = files + 1, bytes = bytes + excluded.bytes;
END;

CREATE TRIGGER uploads_remove AFTER DELETE ON holdings
BEGIN
    UPDATE files_of_labs
    SET files = files - 1, bytes = bytes - (SELECT size FROM blobs WHERE sha256 = OLD.sha256)
    WHERE lab = OLD.lab AND kind = 'upload';
END;

CREATE TRIGGER prepared_add AFTER UPDATE OF prepared ON requests
    WHEN OLD.prepared IS NULL AND NEW.prepared IS NOT NULL AND NEW.what <> 'model'
     AND NOT EXISTS (SELECT 1 FROM requests WHERE prepared = NEW.prepared AND lab = NEW.lab
                                              AND what <> 'model' AND id <> NEW.id)
BEGIN
    INSERT INTO files_of_labs SELECT NEW.lab, 'prepared', 1, size FROM blobs WHERE sha256 = NEW.prepared
    ON CONFLICT (lab, kind) DO UPDATE SET files = files + 1, bytes = bytes + excluded.bytes;
END;

CREATE TRIGGER prepared_remove AFTER DELETE ON requests
    WHEN OLD.prepared IS NOT NULL AND OLD.what <> 'model'
     AND NOT EXISTS (SELECT 1 FROM requests WHERE prepared = OLD.prepared AND lab = OLD.lab
                                              AND what <> 'model')
BEGIN
    UPDATE files_of_labs
    SET files = files - 1, bytes = bytes - (SELECT size FROM blobs WHERE sha256 = OLD.prepared)
    WHERE lab = OLD.lab AND kind = 'prepared';
END;

CREATE TRIGGER movies_add AFTER UPDATE OF result ON tasks
    WHEN NEW.thing IS NOT NULL AND OLD.result IS NULL AND NEW.result IS NOT NULL
BEGIN
    INSERT INTO files_of_labs SELECT NEW.lab, 'movie', 1, size FROM blobs WHERE sha256 = NEW.result
    ON CONFLICT (lab, kind) DO UPDATE SET files = files + 1, bytes = bytes + excluded.bytes;
END;

CREATE TRIGGER movies_remove AFTER DELETE ON tasks
    WHEN OLD.thing IS NOT NULL AND OLD.result IS NOT NULL
BEGIN
    UPDATE files_of_labs
    SET files = files - 1, bytes = bytes - (SELECT size FROM blobs WHERE sha256 = OLD.result)
    WHERE lab = OLD.lab AND kind = 'movie';
END;

CREATE TRIGGER jobs_by_state_add AFTER INSERT ON jobs
BEGIN
    INSERT INTO jobs_by_state VALUES (NEW.lab, NEW.state, 1, NEW.disk_bytes, NEW.result_bytes)
    ON CONFLICT (lab, state) DO UPDATE SET jobs = jobs + 1, disk_bytes = disk_bytes + NEW.disk_bytes,
        result_bytes = result_bytes + NEW.result_bytes;
END;

CREATE TRIGGER jobs_by_state_change AFTER UPDATE OF state, disk_bytes, result_bytes ON jobs
BEGIN
    UPDATE jobs_by_state SET jobs = jobs - 1, disk_bytes = disk_bytes - OLD.disk_bytes,
        result_bytes = result_bytes - OLD.result_bytes
    WHERE lab = OLD.lab AND state = OLD.state;
    INSERT INTO jobs_by_state VALUES (NEW.lab, NEW.state, 1, NEW.disk_bytes, NEW.result_bytes)
    ON CONFLICT (lab, state) DO UPDATE SET jobs = jobs + 1, disk_bytes = disk_bytes + NEW.disk_bytes,
        result_bytes = result_bytes + NEW.result_bytes;
END;

CREATE TRIGGER jobs_by_state_remove AFTER DELETE ON jobs
BEGIN
    UPDATE jobs_by_state SET jobs = jobs - 1, disk_bytes = disk_bytes - OLD.disk_bytes,
        result_bytes = result_bytes - OLD.result_bytes
    WHERE lab = OLD.lab AND state = OLD.state;
END;

CREATE TRIGGER tasks_by_state_add AFTER INSERT ON tasks
BEGIN
    INSERT INTO tasks_by_state VALUES (NEW.kind, NEW.state, 1)
    ON CONFLICT (kind, state) DO UPDATE SET tasks = tasks + 1;
END;

CREATE TRIGGER tasks_by_state_change AFTER UPDATE OF state ON tasks
    WHEN OLD.state <> NEW.state
BEGIN
    UPDATE tasks_by_state SET tasks = tasks - 1 WHERE kind = OLD.kind AND state = OLD.state;
    INSERT INTO tasks_by_state VALUES (NEW.kind, NEW.state, 1)
    ON CONFLICT (kind, state) DO UPDATE SET tasks = tasks + 1;
END;

CREATE TRIGGER tasks_by_state_remove AFTER DELETE ON tasks
BEGIN
    UPDATE tasks_by_state SET tasks = tasks - 1 WHERE kind = OLD.kind AND state = OLD.state;
END;

CREATE TRIGGER changes_cut AFTER INSERT ON changes
BEGIN
    DELETE FROM changes WHERE number <= NEW.number - 10000;
END;

CREATE TRIGGER changes_of_jobs_add AFTER INSERT ON jobs
BEGIN
    INSERT INTO changes (what, lab, id) VALUES ('job', NEW.lab, NEW.id);
END;

CREATE TRIGGER changes_of_jobs_change AFTER UPDATE OF state, label, priority, truth ON jobs
BEGIN
    INSERT INTO changes (what, lab, id) VALUES ('job', NEW.lab, NEW.id);
END;

CREATE TRIGGER changes_of_jobs_remove AFTER DELETE ON jobs
BEGIN
    INSERT INTO changes (what, lab, id) VALUES ('job', OLD.lab, OLD.id);
END;

-- A job changes with its tasks that run, and not with those that become ready.
CREATE TRIGGER changes_of_tasks AFTER UPDATE OF state, iterations, fraction ON tasks
    WHEN NEW.job IS NOT NULL
     AND ((OLD.state = 'running') <> (NEW.state = 'running')
          OR NEW.state = 'running'
             AND (OLD.iterations <> NEW.iterations OR OLD.fraction <> NEW.fraction))
BEGIN
    INSERT INTO changes (what, lab, id) VALUES ('job', NEW.lab, NEW.job);
END;

CREATE TRIGGER changes_of_remote_tasks AFTER UPDATE OF delivery ON remote_tasks
BEGIN
    INSERT INTO changes (what, lab, id) SELECT 'job', lab, job FROM tasks WHERE id = NEW.task;
END;

CREATE TRIGGER changes_of_requests_add AFTER INSERT ON requests
BEGIN
    INSERT INTO changes (what, lab, id) VALUES (NEW.what, NEW.lab, NEW.id);
END;

CREATE TRIGGER changes_of_requests_change AFTER UPDATE OF name, refusal ON requests
BEGIN
    INSERT INTO changes (what, lab, id) VALUES (NEW.what, NEW.lab, NEW.id);
END;

CREATE TRIGGER changes_of_requests_remove AFTER DELETE ON requests
BEGIN
    INSERT INTO changes (what, lab, id) VALUES (OLD.what, OLD.lab, OLD.id);
END;

CREATE TRIGGER changes_of_request_tasks_add AFTER INSERT ON tasks
    WHEN NEW.thing IS NOT NULL
BEGIN
    INSERT INTO changes (what, lab, id) SELECT what, lab, id FROM requests WHERE id = NEW.thing;
END;

CREATE TRIGGER changes_of_request_tasks_change AFTER UPDATE OF state, fraction ON tasks
    WHEN NEW.thing IS NOT NULL AND (OLD.state <> NEW.state OR OLD.fraction <> NEW.fraction)
BEGIN
    INSERT INTO changes (what, lab, id) SELECT what, lab, id FROM requests WHERE id = NEW.thing;
END;

CREATE TRIGGER notifications_add AFTER UPDATE OF state ON jobs
    WHEN NEW.state IN ('succeeded', 'failed', 'cancelled') AND OLD.state <> NEW.state
         AND json_extract(NEW.spec, '$.webhook') IS NOT NULL
BEGIN
    INSERT OR REPLACE INTO notifications (job, next_at) VALUES (NEW.id, 0);
END;

CREATE TRIGGER upload_keys_end AFTER DELETE ON partials
BEGIN
    DELETE FROM request_keys WHERE id = OLD.id;
END;

CREATE TRIGGER remote_tasks_end AFTER UPDATE OF state ON tasks
    WHEN OLD.state = 'running' AND NEW.state <> 'running'
BEGIN
    DELETE FROM remote_tasks WHERE task = NEW.id;
END;

CREATE TRIGGER requests_end AFTER DELETE ON requests
BEGIN
    DELETE FROM tasks WHERE thing = OLD.id;
    DELETE FROM request_keys WHERE id = OLD.id;
END;

CREATE TRIGGER jobs_end AFTER DELETE ON jobs
BEGIN
    DELETE FROM tasks WHERE thing = OLD.id;
    DELETE FROM request_keys WHERE id = OLD.id;
END;
