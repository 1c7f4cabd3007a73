-- Requests of labs for calibrations, measurements and models have one table. Checks of uploads are tasks of the queue.
-- A task without a job belongs to a thing. The program alone knows the kinds of tasks.
CREATE TABLE requests (
    id             TEXT PRIMARY KEY, -- of the calibration, measurement or model
    what           TEXT NOT NULL,    -- 'calibration', 'measurement' or 'model'
    lab            TEXT NOT NULL,
    token          TEXT REFERENCES tokens (id),
    name           TEXT,
    calibration    TEXT,             -- that of a measurement or a model
    request        TEXT NOT NULL,    -- as JSON
    limits         TEXT NOT NULL,    -- of its check, as JSON
    prepared_bytes INTEGER NOT NULL DEFAULT 0, -- promised on the disk for what is being made
    origin         TEXT,             -- identifier of the HTTP request
    refusal        TEXT,             -- why nothing is made, as JSON
    created_at     INTEGER NOT NULL
) STRICT, WITHOUT ROWID;

CREATE INDEX requests_lab ON requests (lab, what, id);
CREATE INDEX requests_calibration ON requests (calibration, what) WHERE calibration IS NOT NULL;

-- The uploads that are still needed to fulfil a request.
CREATE TABLE request_files (
    id     TEXT NOT NULL REFERENCES requests (id) ON DELETE CASCADE,
    sha256 TEXT NOT NULL REFERENCES blobs (sha256),
    PRIMARY KEY (id, sha256)
) STRICT, WITHOUT ROWID;

CREATE INDEX request_files_sha256 ON request_files (sha256);

-- A check that has not ended goes with the key of its request, which may be sent again.
DELETE FROM checks;

INSERT INTO requests (id, what, lab, token, name, request, limits, prepared_bytes, refusal, created_at)
SELECT calibration, 'calibration', asked.lab, asked.token, asked.name,
    iif(captures IS NULL, json_object('masks', masks),
        json_object('captures', json(captures), 'mosaic', asked.mosaic)),
    '{"max_file_bytes":0,"min_free_bytes":0,"seconds":300}',
    iif(masks IS NULL AND tasks.state IS NOT 'failed', prepared_bytes, 0),
    iif(masks IS NULL AND tasks.state = 'failed', json_object('code', 'invalid_content', 'detail',
        coalesce((SELECT reason FROM attempts WHERE task = tasks.id AND attempt = tasks.attempt),
            'no reason is known')), NULL),
    asked.created_at
FROM calibration_requests AS asked LEFT JOIN calibrations ON calibrations.id = calibration
LEFT JOIN tasks USING (calibration);

INSERT INTO requests (id, what, lab, token, name, calibration, request, limits, created_at)
SELECT id, 'measurement', lab, token, name, calibration,
    json_object('calibration', calibration, 'data', data), '{}', created_at FROM measurements;

INSERT INTO requests (id, what, lab, name, calibration, request, limits, created_at)
SELECT id, 'model', lab, name, calibration,
    json_object('calibration', calibration, 'file', file), '{}', created_at FROM models;

INSERT INTO request_files SELECT calibration, sha256 FROM calibration_captures;

-- A constraint can't be changed, so the table is made anew; what goes with its rows is kept aside.
CREATE TABLE attempts_kept AS SELECT * FROM attempts;
CREATE TABLE remote_kept AS SELECT * FROM remote_tasks;

CREATE TABLE tasks_new (
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
    UNIQUE (job, ordinal),
    CHECK ((job IS NULL) <> (thing IS NULL))
) STRICT, WITHOUT ROWID;

INSERT INTO tasks_new (id, job, thing, lab, ordinal, kind, snapshot, snapshots, tile, state, priority, cost,
    attempt, worker, lease_until, stage, iterations, passes, fraction, seconds, ready_at, failures, losses,
    starved, result, record, history)
SELECT id, job, coalesce(calibration, movie), lab, iif(calibration IS NULL, ordinal, 1), kind, snapshot,
    snapshots, tile, state, priority, cost, attempt, worker, lease_until, stage, iterations, passes, fraction,
    seconds, ready_at, failures, losses, starved, result, record, history
FROM tasks;

DROP TABLE tasks;
ALTER TABLE tasks_new RENAME TO tasks;
DROP TABLE checks;
DROP TABLE check_files;
DROP TABLE calibration_captures;
DROP TABLE calibration_requests;

CREATE INDEX tasks_order ON tasks (job, kind, snapshot, state);
CREATE UNIQUE INDEX tasks_thing ON tasks (thing, kind, coalesce(snapshot, -1)) WHERE thing IS NOT NULL;
CREATE INDEX tasks_kept_of_lab ON tasks (lab) WHERE thing IS NOT NULL AND result IS NOT NULL;
CREATE INDEX tasks_checks ON tasks (lab) WHERE kind = 'check' AND state IN ('ready', 'running');
CREATE INDEX tasks_worker ON tasks (worker) WHERE worker IS NOT NULL;
CREATE INDEX tasks_result ON tasks (result) WHERE result IS NOT NULL;
CREATE INDEX tasks_claim ON tasks (state, lab, priority DESC, job, ordinal);
CREATE INDEX tasks_ready ON tasks (job, ordinal) WHERE state = 'ready';
CREATE INDEX tasks_others ON tasks (lab, priority DESC, job, ordinal) WHERE state = 'ready' AND kind <> 'tile';
CREATE INDEX tasks_others_of_job ON tasks (job, ordinal) WHERE state = 'ready' AND kind <> 'tile';
CREATE INDEX tasks_light ON tasks (lab, priority DESC, job, ordinal) WHERE state = 'ready' AND light = 1;
CREATE INDEX tasks_light_of_job ON tasks (job, ordinal) WHERE state = 'ready' AND light = 1;

INSERT OR IGNORE INTO attempts SELECT * FROM attempts_kept;
DROP TABLE attempts_kept;
INSERT OR IGNORE INTO remote_tasks SELECT * FROM remote_kept;
DROP TABLE remote_kept;

-- However a task ends, it is out no more.
CREATE TRIGGER remote_tasks_end AFTER UPDATE OF state ON tasks
    WHEN OLD.state = 'running' AND NEW.state <> 'running'
BEGIN
    DELETE FROM remote_tasks WHERE task = NEW.id;
END;

-- A task goes with its thing; a key lives as long as what it made.
CREATE TRIGGER requests_end AFTER DELETE ON requests
BEGIN
    DELETE FROM tasks WHERE thing = OLD.id;
    DELETE FROM request_keys WHERE id = OLD.id;
END;
CREATE TRIGGER jobs_end AFTER DELETE ON jobs
BEGIN
    DELETE FROM tasks WHERE thing = OLD.id;
END;
DROP TRIGGER measurement_keys_end;
DROP TRIGGER model_keys_end;

-- The light worker computes no tiles, so it counts in no forecast.
ALTER TABLE workers ADD COLUMN light INTEGER NOT NULL DEFAULT 0;
