"""The tables of a run: what a table of before lacks is added."""

from __future__ import annotations

import sqlite3
from contextlib import closing

from monitor.publish.results.tables import insert, make_tables, window_row
from monitor.publish.results.window_fields import KEPT, Field, Kind

LINE = {"t_end_ns": 10, "window_s": 400.0, "misfit": 1.5, "alarm": {"level": "normal"}}


def test_an_older_table_gets_the_columns_of_new_fields() -> None:
    kinds = {"n": Kind.INTEGER, "off": Kind.FLAG, "ids": Kind.INTEGERS, "names": Kind.TEXTS, "by_name": Kind.BY_NAME}
    kept = (*KEPT, *(Field(key, kind, lambda _: None, "", kept=True) for key, kind in kinds.items()))
    new = {"window": 1, "n": 3, "off": True, "ids": [4, 5], "names": ["a"], "by_name": {"level": 0.5}}
    with closing(sqlite3.connect("")) as database:
        make_tables(database)
        database.execute("ALTER TABLE windows DROP COLUMN misfit")
        database.execute("INSERT INTO windows (t_end_ns, window) VALUES (9, 0)")
        database.commit()
        make_tables(database, kept=kept)
        insert(database, "windows", window_row(LINE | new, kept))
        stored = database.execute("SELECT misfit, n, off, ids, names, by_name FROM windows ORDER BY window").fetchall()
        declared = {name: kind for _, name, kind, *_ in database.execute("PRAGMA table_info(windows)")}
    assert stored == [(None,) * 6, (1.5, 3, 1, "[4,5]", '["a"]', '{"level":0.5}')]
    assert declared["n"] == declared["off"] == "INTEGER" and declared["ids"] == "TEXT" and declared["misfit"] == "REAL"
