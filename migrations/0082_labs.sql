-- Labs take turns. Of the labs with a task of the highest priority, the one goes next whose tag is the lowest
-- (start-time fair queueing, Goyal, Vin and Cheng, 1996).
CREATE TABLE labs (
    lab    TEXT PRIMARY KEY,
    share  REAL NOT NULL DEFAULT 1 CHECK (share > 0), -- of the machine, beside the shares of the others
    -- In planned CPU-seconds by share: where the lab stood when its last task was handed out, and where that
    -- task will have brought it.
    start  REAL NOT NULL DEFAULT 0,
    finish REAL NOT NULL DEFAULT 0
) STRICT, WITHOUT ROWID;

INSERT INTO labs (lab)
    SELECT lab FROM jobs UNION SELECT lab FROM calibration_requests UNION SELECT lab FROM tokens;

-- A task belongs to the lab of its job or calibration.
ALTER TABLE tasks ADD COLUMN lab TEXT NOT NULL DEFAULT 'local';
UPDATE tasks SET lab = coalesce(
    (SELECT lab FROM jobs WHERE id = tasks.job),
    (SELECT lab FROM calibration_requests WHERE calibration = tasks.calibration), lab);

DROP INDEX tasks_claim;
CREATE INDEX tasks_claim ON tasks (state, lab, priority DESC, job, ordinal);
CREATE INDEX tasks_ready ON tasks (job, ordinal) WHERE state = 'ready';
DROP INDEX tasks_left;

-- What the tasks of a job add up to, so that nobody has to read all of them to tell how far it is. Counted
-- anew whenever a task ends; what the running ones have done comes on top.
CREATE TABLE job_sums (
    job            TEXT PRIMARY KEY REFERENCES jobs (id) ON DELETE CASCADE,
    -- Planned CPU-seconds: of all tasks, of those that are left, and of the longest one left.
    cost           REAL NOT NULL,
    tiles_left     REAL NOT NULL,
    tiles_longest  REAL NOT NULL,
    others_left    REAL NOT NULL,
    others_longest REAL NOT NULL,
    tiles_total    INTEGER NOT NULL,
    tiles_done     INTEGER NOT NULL,
    tile_seconds   REAL NOT NULL, -- that the tiles took that are done
    tile_cost      REAL NOT NULL, -- and that was planned for them
    prepared       INTEGER NOT NULL,
    previews_done  INTEGER NOT NULL,
    snapshots_done INTEGER NOT NULL,
    iterations     INTEGER NOT NULL, -- of tasks that are done
    passes         INTEGER NOT NULL
) STRICT, WITHOUT ROWID;

INSERT INTO job_sums
    SELECT job, sum(cost),
        sum(iif(kind = 'tile' AND state <> 'done', cost, 0.0)),
        max(iif(kind = 'tile' AND state <> 'done', cost, 0.0)),
        sum(iif(kind <> 'tile' AND state <> 'done', cost, 0.0)),
        max(iif(kind <> 'tile' AND state <> 'done', cost, 0.0)),
        sum(kind = 'tile'), sum(kind = 'tile' AND state = 'done'),
        sum(iif(kind = 'tile' AND state = 'done', coalesce(seconds, 0.0), 0.0)),
        sum(iif(kind = 'tile' AND state = 'done', cost, 0.0)),
        sum(kind = 'prepare' AND state = 'done'),
        sum(kind = 'preview' AND result IS NOT NULL),
        sum(kind = 'assemble' AND state = 'done'),
        sum(iif(state = 'done', iterations, 0)), sum(iif(state = 'done', passes, 0))
    FROM tasks WHERE job IS NOT NULL GROUP BY job;

-- What the last tasks of a kind took, and what they spent of the plan, in sums that fade.
ALTER TABLE totals ADD COLUMN recent_seconds REAL NOT NULL DEFAULT 0;
ALTER TABLE totals ADD COLUMN recent_cost REAL NOT NULL DEFAULT 0;
