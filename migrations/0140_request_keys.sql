-- The keys by which a request that comes twice makes one thing, for all that is no job: a job keeps its own.
CREATE TABLE request_keys (
    lab     TEXT NOT NULL,
    what    TEXT NOT NULL CHECK (what IN ('calibration', 'measurement', 'model', 'upload')),
    key     TEXT NOT NULL,
    request TEXT NOT NULL, -- hash of the request, to tell a repeated one from another one
    id      TEXT NOT NULL, -- what it made
    PRIMARY KEY (lab, what, key)
) STRICT, WITHOUT ROWID;

CREATE INDEX request_keys_id ON request_keys (id);

-- A key lives as long as what it made.
CREATE TRIGGER calibration_keys_end AFTER DELETE ON calibration_requests
BEGIN
    DELETE FROM request_keys WHERE id = OLD.calibration;
END;
CREATE TRIGGER measurement_keys_end AFTER DELETE ON measurements
BEGIN
    DELETE FROM request_keys WHERE id = OLD.id;
END;
CREATE TRIGGER model_keys_end AFTER DELETE ON models
BEGIN
    DELETE FROM request_keys WHERE id = OLD.id;
END;
CREATE TRIGGER upload_keys_end AFTER DELETE ON partials
BEGIN
    DELETE FROM request_keys WHERE id = OLD.id;
END;
