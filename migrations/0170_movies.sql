-- Movies of results, which workers make when somebody asks for one: a task without a job's fate, as a failed movie
-- fails nothing else. A check can't be changed, so the table is made anew; what goes with its rows is kept
-- aside.
CREATE TABLE attempts_kept AS SELECT * FROM attempts;
CREATE TABLE remote_kept AS SELECT * FROM remote_tasks;

CREATE TABLE tasks_new (
    id          TEXT PRIMARY KEY,
    job         TEXT REFERENCES jobs (id) ON DELETE CASCADE, -- NULL for the task of a calibration or a movie
    calibration TEXT REFERENCES calibration_requests (calibration) ON DELETE CASCADE,
    movie       TEXT REFERENCES jobs (id) ON DELETE CASCADE, -- the job of whose frames it is
    lab         TEXT NOT NULL DEFAULT 'local',
    ordinal     INTEGER NOT NULL, -- the order in which the tasks of a job are handed out
    kind        TEXT NOT NULL CHECK (kind IN ('prepare', 'preview', 'pilot', 'tile', 'assemble',
                    'manifest', 'calibration', 'movie')),
    snapshot    INTEGER, -- NULL for the movie of all snapshots
    snapshots   INTEGER NOT NULL DEFAULT 1 CHECK (snapshots > 0),
    tile        INTEGER,
    state       TEXT NOT NULL CHECK (state IN
                    ('blocked', 'ready', 'running', 'done', 'failed', 'cancelled')),
    -- The job's; that of a calibration is higher than any job's, that of a movie lower
    priority    INTEGER NOT NULL,
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
    starved     INTEGER NOT NULL DEFAULT 0, -- deaths for want of memory
    -- Of a task that is done:
    result      TEXT REFERENCES blobs (sha256), -- of a tile or preview, until the job has succeeded; of a movie
    record      TEXT, -- what the worker has to tell about it, as JSON
    history     TEXT, -- how the solver went: [iteration, residual, change, sigma] as JSON
    UNIQUE (job, ordinal),
    CHECK ((job IS NULL) = (kind IN ('calibration', 'movie'))),
    CHECK ((calibration IS NULL) = (kind <> 'calibration')),
    CHECK ((movie IS NULL) = (kind <> 'movie'))
) STRICT, WITHOUT ROWID;

INSERT INTO tasks_new (id, job, calibration, lab, ordinal, kind, snapshot, snapshots, tile, state, priority,
    cost, attempt, worker, lease_until, stage, iterations, passes, fraction, seconds, ready_at, failures,
    losses, starved, result, record, history)
SELECT id, job, calibration, lab, ordinal, kind, snapshot, snapshots, tile, state, priority,
    cost, attempt, worker, lease_until, stage, iterations, passes, fraction, seconds, ready_at, failures,
    losses, starved, result, record, history
FROM tasks;

DROP TABLE tasks;
ALTER TABLE tasks_new RENAME TO tasks;

CREATE INDEX tasks_order ON tasks (job, kind, snapshot, state);
CREATE UNIQUE INDEX tasks_calibration ON tasks (calibration) WHERE calibration IS NOT NULL;
CREATE UNIQUE INDEX tasks_movie ON tasks (movie, coalesce(snapshot, -1)) WHERE movie IS NOT NULL;
CREATE INDEX tasks_movies_of_lab ON tasks (lab) WHERE movie IS NOT NULL;
CREATE INDEX tasks_worker ON tasks (worker) WHERE worker IS NOT NULL;
CREATE INDEX tasks_result ON tasks (result) WHERE result IS NOT NULL;
CREATE INDEX tasks_claim ON tasks (state, lab, priority DESC, job, ordinal);
CREATE INDEX tasks_ready ON tasks (job, ordinal) WHERE state = 'ready';
CREATE INDEX tasks_others ON tasks (lab, priority DESC, job, ordinal) WHERE state = 'ready' AND kind <> 'tile';
CREATE INDEX tasks_others_of_job ON tasks (job, ordinal) WHERE state = 'ready' AND kind <> 'tile';

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
