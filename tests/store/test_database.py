"""Schema, durability settings, clocks."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from alembic import command
from alembic.autogenerate import compare_metadata
from alembic.config import Config
from alembic.migration import MigrationContext
from sqlalchemy import text
from sqlalchemy.exc import IntegrityError

import advtex_store.database
from advtex_store.database import Database, connect, upgrade_database
from advtex_store.models import Base
from advtex_store.settings import StoreSettings

# Rows as a server at revision 0005 writes them.
OLD_UPLOAD = """insert into uploads (id, owner, filename, size, "offset", tus_metadata, created_at)
    values ('u', 'me', '', 1, 1, '', 0)"""
OLD_JOB = """insert into jobs (id, owner, upload_id, state, label, options, priority, memory_bytes, waiting_reason,
    attempt, cancel_requested, reached, reached_at_claim, deaths, log_tail, progress, warnings, results, version,
    created_at, updated_at, retention_seconds)
    values (:id, 'me', 'u', 'queued', '', '{}', 0, :memory, '', 1, false, 0, 0, 0, '', '{}', '[]', '[]', 1, 0, 0, 60)"""


def test_migrations_lead_to_the_models(database_url: str) -> None:
    engine = connect(database_url)
    with engine.connect() as connection:
        context = MigrationContext.configure(connection, opts={"compare_type": True})
        assert compare_metadata(context, Base.metadata) == []
    engine.dispose()


@pytest.mark.parametrize("kind", ["sqlite", "postgresql"])
def test_several_servers_migrate_at_once(kind: str, tmp_path, postgres_server: str) -> None:
    url = f"sqlite:///{tmp_path}/new.db"
    if kind == "postgresql":
        url = f"{postgres_server}race".replace("postgresql:", "postgresql+psycopg:")
        admin = connect(url.replace("/race", "/postgres")).execution_options(isolation_level="AUTOCOMMIT")
        with admin.connect() as connection:
            connection.execute(text("create database race"))
        admin.dispose()
    errors: list[Exception] = []

    def upgrade() -> None:
        try:
            upgrade_database(url)
        except Exception as error:
            errors.append(error)

    threads = [threading.Thread(target=upgrade) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert errors == []
    database = Database(url)
    with database.read() as session:
        assert session.execute(text("select count(*) from alembic_version")).scalar_one() == 1
    database.close()


@pytest.mark.parametrize("kind", ["sqlite", "postgresql"])
def test_lines_come_to_an_old_database_and_go_again(kind: str, tmp_path, postgres_server: str) -> None:
    """With 100,000 jobs in it, and without waiting long; rows of an older server have their class too."""
    url = f"sqlite:///{tmp_path}/old.db"
    if kind == "postgresql":
        url = f"{postgres_server}lines".replace("postgresql:", "postgresql+psycopg:")
        admin = connect(url.replace("/lines", "/postgres")).execution_options(isolation_level="AUTOCOMMIT")
        with admin.connect() as connection:
            connection.execute(text("create database lines"))
        admin.dispose()
    engine = connect(url)
    config = Config()
    config.set_main_option("script_location", str(Path(advtex_store.database.__file__).parent / "migrations"))

    def migrate(act: Callable[[Config, str], None], revision: str) -> None:
        with engine.connect().execution_options(write=True) as connection, connection.begin():
            config.attributes["connection"] = connection
            act(config, revision)

    def add_jobs(first: int, count: int) -> None:
        jobs = [{"id": f"{n:08x}", "memory": (n % 5) << 29} for n in range(first, first + count)]
        with engine.connect().execution_options(write=True) as connection, connection.begin():
            connection.execute(text(OLD_JOB), jobs)

    def classes() -> list[tuple[int, int, int]]:
        query = "select memory_bytes, memory_gib, count(*) from jobs group by 1, 2 order by 1"
        with engine.connect() as connection:
            return [tuple(row) for row in connection.execute(text(query))]

    migrate(command.upgrade, "0005")
    with engine.connect().execution_options(write=True) as connection, connection.begin():
        connection.execute(text(OLD_UPLOAD))
    add_jobs(0, 100_000)
    began = time.monotonic()
    migrate(command.upgrade, "0008")
    assert time.monotonic() - began < 60
    add_jobs(100_000, 5)  # by a server that does not know of classes
    sizes = [(0, 0), (1 << 29, 1), (1 << 30, 1), (3 << 29, 2), (1 << 31, 2)]
    assert classes() == [(size, gib, 20_001) for size, gib in sizes]
    migrate(command.downgrade, "0005")
    with engine.connect() as connection:
        assert connection.execute(text("select count(*) from jobs where state = 'queued'")).scalar_one() == 100_005
    migrate(command.upgrade, "0008")
    assert classes() == [(size, gib, 20_001) for size, gib in sizes]
    engine.dispose()


def test_connections_that_open_a_new_file_at_once_wait_for_each_other(tmp_path) -> None:
    """SQLite refuses some of those that switch a file to WAL, whatever its timeout."""
    errors: list[Exception] = []

    def open_file(url: str, barrier: threading.Barrier) -> None:
        engine = connect(url)
        barrier.wait()
        try:
            engine.connect().close()
        except Exception as error:
            errors.append(error)
        engine.dispose()

    for number in range(100):
        one = (f"sqlite:///{tmp_path}/{number}.db", threading.Barrier(6))
        threads = [threading.Thread(target=open_file, args=one) for _ in range(6)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert errors == []


def test_sqlite_is_durable(sqlite_url: str) -> None:
    database = Database(sqlite_url)
    with database.read() as session:
        values = [session.execute(text(f"pragma {name}")).scalar() for name in ("journal_mode", "synchronous")]
        assert values == ["wal", 2]
        assert session.execute(text("pragma foreign_keys")).scalar() == 1
    database.close()


def test_a_failed_write_leaves_nothing(database_url: str) -> None:
    database = Database(database_url)
    insert = text(
        "insert into uploads (id, owner, filename, size, \"offset\", created_at) values ('a', 'o', '', 1, 0, 0)"
    )

    def write_twice() -> None:
        with database.write() as session:
            session.execute(insert)
            session.execute(insert)

    with pytest.raises(IntegrityError):
        write_twice()
    with database.read() as session:
        assert session.execute(text("select count(*) from uploads")).scalar_one() == 0
    database.close()


def test_the_clock_is_the_time(database_url: str) -> None:
    database = Database(database_url)
    with database.read() as session:
        assert abs(database.now(session) - time.time()) < 5
    database.close()


def test_settings(monkeypatch: pytest.MonkeyPatch, tmp_path) -> None:
    monkeypatch.setenv("ADVTEX_DATA_DIR", str(tmp_path))
    settings = StoreSettings()
    assert settings.database == f"sqlite:///{tmp_path}/advtex.db"
    assert settings.blobs == f"file://{tmp_path}/blobs"
    assert settings.redis_password() is None
    monkeypatch.setenv("ADVTEX_DATABASE_URL", "postgresql://u@h/d")
    monkeypatch.setenv("ADVTEX_BLOB_URL", "s3://bucket/prefix")
    (tmp_path / "password").write_text("secret\n")
    monkeypatch.setenv("ADVTEX_REDIS_PASSWORD_FILE", str(tmp_path / "password"))
    settings = StoreSettings()
    assert settings.database == "postgresql+psycopg://u@h/d"
    assert settings.blobs == "s3://bucket/prefix"
    assert settings.redis_password() == "secret"


def test_connections_that_are_in_use_at_the_end_are_closed_too(database_url: str) -> None:
    """A server that stops leaves threads behind that still ask, and may ask once more."""
    database = Database(database_url)
    used = []
    for number in range(3):
        with database.read() as session:
            used.append(session.connection().connection.dbapi_connection)
            if number == 0:
                database.close()
            assert session.execute(text("select 1")).scalar_one() == 1
    for connection in used:
        assert connection is not None
        with pytest.raises(connect(database_url).dialect.loaded_dbapi.Error, match="closed"):
            connection.cursor().execute("select 1")
