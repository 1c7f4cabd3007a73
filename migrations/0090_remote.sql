-- Tiles that are out with workers on other machines. They have no lease that runs out: the hub judges
-- whether their workers live.
CREATE TABLE remote_tasks (
    task     TEXT PRIMARY KEY REFERENCES tasks (id) ON DELETE CASCADE,
    pool     TEXT NOT NULL, -- the workers that may have it
    attempt  INTEGER NOT NULL, -- that of the message; when the message is delivered again, `tasks` counts on
    -- Where the message is; none until it is published:
    stream   TEXT, -- when its stream was made
    seq      INTEGER, -- its number there
    delivery INTEGER NOT NULL DEFAULT 0 -- the last one that a worker has begun with; 0 for none
) STRICT, WITHOUT ROWID;

CREATE INDEX remote_tasks_pool ON remote_tasks (pool);

-- However a task ends, it is out no more.
CREATE TRIGGER remote_tasks_end AFTER UPDATE OF state ON tasks
    WHEN OLD.state = 'running' AND NEW.state <> 'running'
BEGIN
    DELETE FROM remote_tasks WHERE task = NEW.id;
END;

-- Of workers on other machines.
ALTER TABLE workers ADD COLUMN host TEXT;
ALTER TABLE workers ADD COLUMN pool TEXT;
ALTER TABLE workers ADD COLUMN device TEXT;
