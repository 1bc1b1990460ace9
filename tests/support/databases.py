"""Populated databases of every revision, kept as JSON in `tests/store/databases`: table -> rows.

`python tests/support/databases.py 0006` begins the one of a new revision with what its migration makes of the one
before; put rows and values into what is new by hand: every column must have one that is not null.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, MetaData, Table, select, text

from advtex_store.database import connect, migrate_database
from advtex_store.schema import revisions

FOLDER = Path(__file__).parents[1] / "store" / "databases"

Rows = dict[str, list[dict[str, Any]]]


def kept(revision: str) -> Rows:
    rows: Rows = json.loads((FOLDER / f"{revision}.json").read_text())
    return rows


def load(url: str, revision: str) -> Rows:
    """Make an empty database one of this revision with its rows. -> these"""
    migrate_database(url, revision)
    rows = kept(revision)
    engine = connect(url)
    with engine.execution_options(write=True).begin() as connection:
        for table in tables(connection):
            computed = {column.name for column in table.columns if column.computed is not None}
            for row in rows.get(table.name, ()):
                connection.execute(table.insert().values({n: v for n, v in row.items() if n not in computed}))
    engine.dispose()
    return rows


def read(url: str) -> Rows:
    """All rows of a database, in the order of their keys."""
    engine = connect(url)
    with engine.connect() as connection:
        found = {table.name: [dict(row) for row in _rows(connection, table)] for table in tables(connection)}
    engine.dispose()
    return found


def give_revision(url: str, revision: str) -> None:
    """Let the database say that it is of this revision, whatever it holds."""
    engine = connect(url)
    with engine.execution_options(write=True).begin() as connection:
        connection.execute(text("update alembic_version set version_num = :revision"), {"revision": revision})
    engine.dispose()


def tables(connection: Connection) -> list[Table]:
    """As they are in the database, those first that others refer to."""
    found = MetaData()
    found.reflect(connection)
    return [table for table in found.sorted_tables if table.name != "alembic_version"]


def _rows(connection: Connection, table: Table) -> list[Any]:
    return list(connection.execute(select(table).order_by(*table.primary_key.columns)).mappings())


def write(revision: str, rows: Rows) -> None:
    """One row a line, so that a change of one is seen."""
    parts = []
    for table, found in rows.items():
        lines = ",\n".join("  " + json.dumps(row, ensure_ascii=False) for row in found)
        parts.append(f'"{table}": [\n{lines}\n]')
    (FOLDER / f"{revision}.json").write_text("{\n" + ",\n".join(parts) + "\n}\n")


def main(revision: str) -> None:
    import tempfile

    before = revisions()[revisions().index(revision) - 1]
    with tempfile.TemporaryDirectory() as folder:
        url = f"sqlite:///{folder}/kept.db"
        load(url, before)
        migrate_database(url, revision)
        write(revision, read(url))


if __name__ == "__main__":
    main(sys.argv[1])
