-- Calibrations of ready masks, and measurements, whose check goes on after their request was answered, and those that
-- did not pass. What has passed stands in its own table instead.
CREATE TABLE checks (
    id          TEXT PRIMARY KEY, -- of what is to be made
    what        TEXT NOT NULL CHECK (what IN ('calibration', 'measurement')),
    lab         TEXT NOT NULL,
    token       TEXT REFERENCES tokens (id),
    name        TEXT,
    calibration TEXT,             -- that of a measurement
    request     TEXT NOT NULL,    -- as JSON
    begun       INTEGER NOT NULL DEFAULT 1, -- how often: the check may be what ended the service
    problem     TEXT,             -- why it did not pass, as JSON
    created_at  INTEGER NOT NULL
) STRICT, WITHOUT ROWID;

CREATE INDEX checks_lab ON checks (lab, what, id);
CREATE INDEX checks_calibration ON checks (calibration) WHERE calibration IS NOT NULL;

-- The uploads that are checked.
CREATE TABLE check_files (
    id     TEXT NOT NULL REFERENCES checks (id) ON DELETE CASCADE,
    sha256 TEXT NOT NULL REFERENCES blobs (sha256),
    PRIMARY KEY (id, sha256)
) STRICT, WITHOUT ROWID;

CREATE INDEX check_files_sha256 ON check_files (sha256);

-- A key lives as long as what it made, or is to make.
CREATE TRIGGER check_keys_end AFTER DELETE ON checks
WHEN NOT EXISTS (SELECT 1 FROM calibration_requests WHERE calibration = OLD.id)
    AND NOT EXISTS (SELECT 1 FROM measurements WHERE id = OLD.id)
BEGIN
    DELETE FROM request_keys WHERE id = OLD.id;
END;
