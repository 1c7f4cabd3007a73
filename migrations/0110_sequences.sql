-- A tile may belong to several snapshots, which are reconstructed together: to so many, of which `snapshot`
-- is the first.
ALTER TABLE tasks ADD COLUMN snapshots INTEGER NOT NULL DEFAULT 1 CHECK (snapshots > 0);

-- Whether the snapshots follow one another without a gap: those that are there already do, unless the camera's
-- times show a pause of more than a frame.
ALTER TABLE measurements ADD COLUMN sequence TEXT NOT NULL DEFAULT 'contiguous'
    CHECK (sequence IN ('contiguous', 'separate'));
UPDATE measurements SET sequence = 'separate'
WHERE 1.0 / camera_fps - exposure_s
    > exposure_s / (SELECT frames FROM calibrations WHERE calibrations.id = calibration);
