-- What has been done in all, for figures that only grow: jobs and their tasks may be deleted.
CREATE TABLE totals (
    kind       TEXT PRIMARY KEY, -- of task
    tasks      INTEGER NOT NULL,
    seconds    REAL NOT NULL,
    iterations INTEGER NOT NULL,
    passes     INTEGER NOT NULL
) STRICT, WITHOUT ROWID;
