-- Displacement of the bands of a spectral camera, as JSON; NULL for masks that were uploaded one by one.
ALTER TABLE calibrations ADD COLUMN dispersion TEXT;
