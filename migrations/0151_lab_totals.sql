-- What labs have had done in all, for figures that only grow: jobs may be deleted.
CREATE TABLE lab_totals (
    lab          TEXT PRIMARY KEY,
    jobs_begun   INTEGER NOT NULL DEFAULT 0,
    wait_seconds REAL NOT NULL DEFAULT 0, -- of those, from submission to the start of the first task
    cpu_seconds  REAL NOT NULL DEFAULT 0  -- of tasks that are done
) STRICT, WITHOUT ROWID;
