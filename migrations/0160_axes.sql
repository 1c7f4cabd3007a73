-- How the axes of an uploaded array were read: as stated, or as the one order that fits. NULL: pictures, arrays of
-- two dimensions, and files that were taken in before this was kept.
ALTER TABLE calibrations ADD COLUMN axes TEXT;
ALTER TABLE measurements ADD COLUMN axes TEXT;
