-- What a lab may have; NULL: no limit of its own.
ALTER TABLE labs ADD COLUMN max_bytes INTEGER CHECK (max_bytes >= 0);
ALTER TABLE labs ADD COLUMN max_jobs INTEGER CHECK (max_jobs >= 0);

-- Prepared arrays count against the token that had them made, as uploads do.
ALTER TABLE calibrations ADD COLUMN token TEXT REFERENCES tokens (id);
ALTER TABLE measurements ADD COLUMN token TEXT REFERENCES tokens (id);
ALTER TABLE calibration_requests ADD COLUMN token TEXT REFERENCES tokens (id);

-- Bytes of the masks that are to be made of captures.
ALTER TABLE calibration_requests ADD COLUMN prepared_bytes INTEGER NOT NULL DEFAULT 0;
