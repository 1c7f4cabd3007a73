-- What time the service has seen, and how long it had run by then (in milliseconds): a clock that was wrong for
-- a while must not make old what is young.
CREATE TABLE clock (
    run  INTEGER PRIMARY KEY,
    wall INTEGER NOT NULL
) STRICT;
