CREATE TABLE rates (
    -- Fading sums over the last tasks of a kind on a device.
    kind    TEXT NOT NULL,
    device  TEXT NOT NULL, -- as in `workers`
    seconds REAL NOT NULL, -- duration
    cost    REAL NOT NULL, -- planned CPU-seconds that were really used
    PRIMARY KEY (kind, device)
) STRICT, WITHOUT ROWID;

INSERT INTO rates SELECT kind, 'cpu', recent_seconds, recent_cost FROM totals;
ALTER TABLE totals DROP COLUMN recent_seconds;
ALTER TABLE totals DROP COLUMN recent_cost;

ALTER TABLE workers ADD COLUMN others INTEGER NOT NULL DEFAULT 1; -- 1 if it takes other tasks of jobs

-- Workers on a GPU take tiles and pilots, pools tiles alone. The sums of tiles in `job_sums` include the pilot.
DROP INDEX tasks_tiles;
DROP INDEX tasks_tiles_of_job;
CREATE INDEX tasks_tiles ON tasks (lab, priority DESC, job, ordinal)
    WHERE state = 'ready' AND kind IN ('tile', 'pilot');
CREATE INDEX tasks_tiles_of_job ON tasks (job, ordinal) WHERE state = 'ready' AND kind IN ('tile', 'pilot');
