-- Work on calibrations: masks from raw captures, and reports. One row a calibration; a calibration
-- that is made of captures has a row in `calibrations` only when its masks are there.
CREATE TABLE calibration_tasks (
    calibration TEXT PRIMARY KEY,
    lab         TEXT NOT NULL,
    name        TEXT,
    captures    TEXT, -- as JSON; NULL if the masks were sent
    state       TEXT NOT NULL CHECK (state IN ('ready', 'running', 'done', 'failed')),
    attempt     INTEGER NOT NULL DEFAULT 0, -- the number of the last attempt; the fence against older ones
    worker      TEXT,
    lease_until INTEGER,
    fraction    REAL NOT NULL DEFAULT 0,
    failures    INTEGER NOT NULL DEFAULT 0,
    losses      INTEGER NOT NULL DEFAULT 0,
    ready_at    INTEGER NOT NULL DEFAULT 0,
    error       TEXT,
    created_at  INTEGER NOT NULL
) STRICT, WITHOUT ROWID;

CREATE INDEX calibration_tasks_state ON calibration_tasks (state);

-- The uploads that a calibration still needs.
CREATE TABLE calibration_captures (
    calibration TEXT NOT NULL REFERENCES calibration_tasks (calibration) ON DELETE CASCADE,
    sha256      TEXT NOT NULL REFERENCES blobs (sha256),
    PRIMARY KEY (calibration, sha256)
) STRICT, WITHOUT ROWID;

CREATE INDEX calibration_captures_blob ON calibration_captures (sha256);

CREATE TABLE calibration_reports (
    calibration TEXT PRIMARY KEY REFERENCES calibrations (id) ON DELETE CASCADE,
    report      TEXT NOT NULL -- as JSON
) STRICT, WITHOUT ROWID;

-- Pictures of a report: small PNGs.
CREATE TABLE calibration_maps (
    calibration TEXT NOT NULL REFERENCES calibrations (id) ON DELETE CASCADE,
    name        TEXT NOT NULL,
    png         BLOB NOT NULL,
    PRIMARY KEY (calibration, name)
) STRICT;

-- Reports for the calibrations that are there already.
INSERT INTO calibration_tasks (calibration, lab, state, created_at)
SELECT id, lab, 'ready', created_at FROM calibrations;

-- What a measurement's check against its calibration found, as JSON; NULL for older ones.
ALTER TABLE measurements ADD COLUMN warnings TEXT;
ALTER TABLE measurements ADD COLUMN dark TEXT; -- hashes of the dark captures that were subtracted, as JSON
