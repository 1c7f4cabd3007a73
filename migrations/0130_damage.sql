-- When a file was found missing, or with other bytes than those on record; NULL as far as is known.
ALTER TABLE blobs ADD COLUMN damaged_at INTEGER;
ALTER TABLE result_files ADD COLUMN damaged_at INTEGER;

CREATE INDEX blobs_damaged ON blobs (sha256) WHERE damaged_at IS NOT NULL;
CREATE INDEX result_files_damaged ON result_files (job, snapshot) WHERE damaged_at IS NOT NULL;

-- How far the slow look at all stored files has come. One row.
CREATE TABLE scrub (
    one        INTEGER PRIMARY KEY CHECK (one = 1),
    started_at INTEGER NOT NULL,
    place      TEXT -- the last file that was looked at, as JSON; NULL before the first and after the last
) STRICT;
