#!/usr/bin/env python3
"""Merges all migrations into migrations/0001_baseline.sql. For use before a release only.

The script applies migrations/*.sql to an empty database and writes the resulting schema: tables with their
indexes in the order of their creation, then triggers. SQLite keeps the comments that stand inside a statement.
A column that was added by ALTER TABLE stands at the end of its table; move it, and its comment, by hand. Then
shorten MIGRATIONS in crates/store/src/migrations.rs.

    scripts/squash-migrations.py            writes the baseline and removes the other migrations
    scripts/squash-migrations.py --compare FILE...   exits with 1 unless these migrations make the same schema
"""

import pathlib
import sqlite3
import sys

FOLDER = pathlib.Path(__file__).resolve().parent.parent / "migrations"


def migrated(paths):
    database = sqlite3.connect(":memory:", isolation_level=None)
    database.execute("PRAGMA foreign_keys = ON")
    for path in paths:
        database.executescript(pathlib.Path(path).read_text())
    return database


def baseline(database):
    rows = "SELECT type, name, tbl_name, sql FROM sqlite_master WHERE sql IS NOT NULL ORDER BY rowid"
    statements = database.execute(rows).fetchall()
    parts = []
    for kind, name, _, text in statements:
        if kind == "table":
            indexes = [sql for kind, _, table, sql in statements if kind == "index" and table == name]
            parts += [text.replace(f'"{name}"', name) + ";"]
            parts += ["\n".join(sql + ";" for sql in indexes)] if indexes else []
    parts += [text + ";" for kind, _, _, text in statements if kind == "trigger"]
    rows = [name for kind, name, _, _ in statements if kind == "table"]
    filled = [name for name in rows if database.execute(f"SELECT 1 FROM {name}").fetchone()]
    if filled:
        sys.exit(f"the migrations write rows to {', '.join(filled)}: add them to the baseline by hand")
    return "-- The schema of version 0.1.0.\n\n" + "\n\n".join(parts) + "\n"


def schema(database):
    """Columns, references, indexes and triggers, without the order of columns and without white space."""
    found = {}
    for kind, name, text in database.execute("SELECT type, name, sql FROM sqlite_master").fetchall():
        if kind == "table":
            columns = database.execute(f"PRAGMA table_xinfo({name})").fetchall()
            references = database.execute(f"PRAGMA foreign_key_list({name})").fetchall()
            found[name] = sorted(row[1:4] + row[5:] for row in columns), sorted(row[2:] for row in references)
        elif text:
            found[name] = " ".join(text.split())
    return found


def main():
    current = sorted(FOLDER.glob("*.sql"))
    if sys.argv[1:2] == ["--compare"]:
        ours, theirs = schema(migrated(current)), schema(migrated(sys.argv[2:]))
        differ = sorted(name for name in ours.keys() | theirs.keys() if ours.get(name) != theirs.get(name))
        for name in differ:
            print(f"{name}\n  here:  {ours.get(name)}\n  there: {theirs.get(name)}")
        sys.exit(bool(differ))
    text = baseline(migrated(current))
    for path in current:
        path.unlink()
    (FOLDER / "0001_baseline.sql").write_text(text)


main()
