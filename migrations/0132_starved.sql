-- Deaths of workers at a task for want of memory, since the job was last (re)started.
ALTER TABLE tasks ADD COLUMN starved INTEGER NOT NULL DEFAULT 0;
