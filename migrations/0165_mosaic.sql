-- The colours of a sensor's pixels, row by row of a cell of 2x2; NULL for a grey sensor.
ALTER TABLE calibrations ADD COLUMN mosaic TEXT CHECK (mosaic IN ('rggb', 'bggr', 'grbg', 'gbrg'));
ALTER TABLE calibration_requests ADD COLUMN mosaic TEXT CHECK (mosaic IN ('rggb', 'bggr', 'grbg', 'gbrg'));
