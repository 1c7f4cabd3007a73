-- Calibrations stand in the queue like all other work: a task without a job. What is not the queue's stays
-- behind, as what was asked for; the name of the table says so from now on.
DROP INDEX calibration_tasks_state;
ALTER TABLE calibration_tasks RENAME TO calibration_requests;

-- A check can't be changed, so the table is made anew; its attempts would go with it, so they are kept
-- aside.
CREATE TABLE attempts_kept AS SELECT * FROM attempts;

CREATE TABLE tasks_new (
    id          TEXT PRIMARY KEY,
    job         TEXT REFERENCES jobs (id) ON DELETE CASCADE, -- NULL for the task of a calibration
    calibration TEXT REFERENCES calibration_requests (calibration) ON DELETE CASCADE,
    ordinal     INTEGER NOT NULL, -- the order in which the tasks of a job are handed out
    kind        TEXT NOT NULL CHECK (kind IN ('prepare', 'preview', 'pilot', 'tile', 'assemble',
                    'manifest', 'calibration')),
    snapshot    INTEGER,
    tile        INTEGER,
    state       TEXT NOT NULL CHECK (state IN
                    ('blocked', 'ready', 'running', 'done', 'failed', 'cancelled')),
    priority    INTEGER NOT NULL, -- the job's; that of a calibration is higher than any job's
    cost        REAL NOT NULL CHECK (cost >= 0), -- planned CPU-seconds, as the weight of progress
    -- Of the attempt that runs or ran last:
    attempt     INTEGER NOT NULL DEFAULT 0, -- its number, from 1; also the fence against older ones
    worker      TEXT, -- of the attempt that runs
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
    result      TEXT REFERENCES blobs (sha256), -- of a tile or preview, until the job has succeeded
    record      TEXT, -- what the worker has to tell about it, as JSON
    history     TEXT, -- how the solver went: [iteration, residual, change, sigma] as JSON
    UNIQUE (job, ordinal),
    CHECK ((job IS NULL) = (kind = 'calibration')),
    CHECK ((calibration IS NULL) = (kind <> 'calibration'))
) STRICT, WITHOUT ROWID;

INSERT INTO tasks_new (id, job, ordinal, kind, snapshot, tile, state, priority, cost, attempt, worker,
    lease_until, stage, iterations, passes, fraction, seconds, ready_at, failures, losses, result, record,
    history)
SELECT id, job, ordinal, kind, snapshot, tile, state, priority, cost, attempt, worker,
    lease_until, stage, iterations, passes, fraction, seconds, ready_at, failures, losses, result, record,
    history
FROM tasks;

-- The task of a calibration that is there already has the calibration's identifier.
INSERT INTO tasks_new (id, calibration, ordinal, kind, state, priority, cost, attempt, worker, lease_until,
    fraction, ready_at, failures, losses)
SELECT calibration, calibration, 0, 'calibration', state, 1000, 0, attempt, worker, lease_until,
    fraction, ready_at, failures, losses
FROM calibration_requests;

DROP TABLE tasks;
ALTER TABLE tasks_new RENAME TO tasks;

CREATE INDEX tasks_claim ON tasks (state, priority DESC, job, ordinal);
CREATE INDEX tasks_order ON tasks (job, kind, snapshot, state);
CREATE UNIQUE INDEX tasks_calibration ON tasks (calibration) WHERE calibration IS NOT NULL;
CREATE INDEX tasks_worker ON tasks (worker) WHERE worker IS NOT NULL;
CREATE INDEX tasks_result ON tasks (result) WHERE result IS NOT NULL;
CREATE INDEX tasks_left ON tasks (priority DESC, job, state, cost, fraction)
    WHERE state IN ('blocked', 'ready', 'running');

INSERT OR IGNORE INTO attempts SELECT * FROM attempts_kept;
DROP TABLE attempts_kept;

-- Attempts at calibrations were not recorded: when they began is not known, nor whose the failed ones were.
INSERT INTO attempts (task, attempt, worker, started_at, ended_at, outcome, reason)
SELECT calibration, attempt, coalesce(worker, ''), created_at,
    CASE state WHEN 'failed' THEN created_at END, CASE state WHEN 'failed' THEN 'failed' END,
    CASE state WHEN 'failed' THEN error END
FROM calibration_requests WHERE state IN ('running', 'failed');

ALTER TABLE calibration_requests DROP COLUMN state;
ALTER TABLE calibration_requests DROP COLUMN attempt;
ALTER TABLE calibration_requests DROP COLUMN worker;
ALTER TABLE calibration_requests DROP COLUMN lease_until;
ALTER TABLE calibration_requests DROP COLUMN fraction;
ALTER TABLE calibration_requests DROP COLUMN failures;
ALTER TABLE calibration_requests DROP COLUMN losses;
ALTER TABLE calibration_requests DROP COLUMN ready_at;
ALTER TABLE calibration_requests DROP COLUMN error;

-- Jobs that have not ended; a job has ended when it has a time at which it did.
CREATE INDEX jobs_unfinished ON jobs (id) WHERE finished_at IS NULL;
