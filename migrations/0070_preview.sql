-- Two more kinds of task: previews, and the pilot of an adaptive schedule. A check can't be changed, so
-- the table is made anew; its attempts would go with it, so they are kept aside.
CREATE TABLE attempts_kept AS SELECT * FROM attempts;

CREATE TABLE tasks_new (
    id          TEXT PRIMARY KEY,
    job         TEXT NOT NULL REFERENCES jobs (id) ON DELETE CASCADE,
    ordinal     INTEGER NOT NULL, -- the order in which the tasks of a job are handed out
    kind        TEXT NOT NULL CHECK (kind IN
                    ('prepare', 'preview', 'pilot', 'tile', 'assemble', 'manifest')),
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
    result      TEXT REFERENCES blobs (sha256), -- of a tile or preview, until the job has succeeded
    record      TEXT, -- what the worker has to tell about it, as JSON
    history     TEXT, -- how the solver went: [iteration, residual, change, sigma] as JSON
    UNIQUE (job, ordinal)
) STRICT, WITHOUT ROWID;

INSERT INTO tasks_new (id, job, ordinal, kind, snapshot, tile, state, priority, cost, attempt, worker,
    lease_until, stage, iterations, passes, fraction, seconds, ready_at, failures, losses, result, record,
    history)
SELECT id, job, ordinal, kind, snapshot, tile, state, priority, cost, attempt, worker,
    lease_until, stage, iterations, passes, fraction, seconds, ready_at, failures, losses, result, record,
    history
FROM tasks;
DROP TABLE tasks;
ALTER TABLE tasks_new RENAME TO tasks;

CREATE INDEX tasks_claim ON tasks (state, priority DESC, job, ordinal);
CREATE INDEX tasks_order ON tasks (job, kind, snapshot, state);
CREATE INDEX tasks_worker ON tasks (worker) WHERE state = 'running';
CREATE INDEX tasks_result ON tasks (result) WHERE result IS NOT NULL;
CREATE INDEX tasks_left ON tasks (priority DESC, job, state, cost, fraction)
    WHERE state IN ('blocked', 'ready', 'running');

INSERT OR IGNORE INTO attempts SELECT * FROM attempts_kept;
DROP TABLE attempts_kept;
