-- What is left to do, in the order in which it is served: the forecast of every unfinished job reads
-- all of it, and with thousands of waiting jobs must not touch the tasks themselves.
CREATE INDEX tasks_left ON tasks (priority DESC, job, state, cost, fraction)
    WHERE state IN ('blocked', 'ready', 'running');
