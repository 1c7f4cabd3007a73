-- How the solver went: a bounded list of [iteration, residual, change, sigma] as JSON, written with
-- the heartbeats.
ALTER TABLE tasks ADD COLUMN history TEXT;
