-- How good the frames of a job are expected to be, as JSON; NULL until it is done, and where nothing can be told.
ALTER TABLE jobs ADD COLUMN assessment TEXT;
