-- What the folder of this database is called, and how often it was opened to be served, at least: the
-- marker sci-recon.json in the folder says the same. One row.
CREATE TABLE folder (
    one        INTEGER PRIMARY KEY CHECK (one = 1),
    id         TEXT NOT NULL,
    generation INTEGER NOT NULL -- only rises; 0 until the marker has been written
) STRICT;
