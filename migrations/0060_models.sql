-- End-to-end networks, each for one calibration.
CREATE TABLE models (
    id          TEXT PRIMARY KEY,
    lab         TEXT NOT NULL,
    name        TEXT,
    calibration TEXT NOT NULL REFERENCES calibrations (id),
    file        TEXT NOT NULL REFERENCES blobs (sha256), -- the ONNX file
    facts       TEXT NOT NULL, -- what its check has found, as JSON
    created_at  INTEGER NOT NULL
) STRICT, WITHOUT ROWID;

CREATE INDEX models_lab ON models (lab, id);
CREATE INDEX models_calibration ON models (calibration);
CREATE INDEX models_file ON models (file);

-- The network of a job of algorithm `learned`.
ALTER TABLE jobs ADD COLUMN model TEXT REFERENCES models (id);
CREATE INDEX jobs_model ON jobs (model);
