"""One database behind two dialects: SQLite (WAL) on one machine, PostgreSQL in a fleet."""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import structlog
from alembic import command
from alembic.config import Config
from sqlalchemy import Connection, Engine, create_engine, event, text
from sqlalchemy.engine import make_url
from sqlalchemy.orm import Session
from sqlalchemy.pool import ConnectionPoolEntry

from advtex_store.errors import SchemaRefused
from advtex_store.schema import MIGRATIONS, Schema, revisions

# A cut line is noticed in seconds, and what it left open is given up: rows that it had locked would block everybody.
POSTGRES_LINE = {"connect_timeout": 5, "tcp_user_timeout": 10_000, "keepalives_idle": 10, "keepalives_interval": 5}
POSTGRES_LIMITS = "-c statement_timeout=30s -c lock_timeout=15s -c idle_in_transaction_session_timeout=20s"
SQLITE_POOL = 40
SQLITE_WAIT = 30  # seconds, for another connection's lock
WAL_WRITE_LOCK = "120"  # the byte of the -shm file that a writer locks
MIGRATION_LOCK = 0x61647674  # any constant that only this service uses as a PostgreSQL advisory lock

log = structlog.get_logger("advtex.database")


class Database:
    """Short transactions on one engine.

    clock: replaces the time source in tests. By default SQLite uses this machine's clock and PostgreSQL its own, so
    that leases do not depend on the clocks of workers.
    """

    def __init__(self, url: str, clock: Callable[[], float] | None = None) -> None:
        self.engine = connect(url, POSTGRES_LIMITS)
        self._clock = clock

    @contextmanager
    def read(self) -> Iterator[Session]:
        """A session that does not write."""
        with Session(self.engine, expire_on_commit=False) as session:
            yield session

    @contextmanager
    def write(self) -> Iterator[Session]:
        """A session that commits at the end, or rolls back. SQLite takes the write lock at the start, because a read
        transaction that turns into a write one fails at once when another writer came between."""
        with (
            self.engine.connect().execution_options(write=True) as connection,
            Session(connection, expire_on_commit=False) as session,
            session.begin(),
        ):
            yield session

    def now(self, session: Session) -> float:
        """Seconds since 1970."""
        if self._clock is not None:
            return self._clock()
        if self.engine.dialect.name == "sqlite":
            return time.time()
        return float(session.execute(text("select extract(epoch from clock_timestamp())")).scalar_one())

    def blocked(self, seconds: float = 5.0) -> str | None:
        """Why nobody can write: SQLite's one lock is held for longer than that, by a process that may be frozen.

        None if it is free sooner, and on PostgreSQL, which gives up such transactions by itself.
        """
        path = self.engine.url.database
        if self.engine.dialect.name != "sqlite" or not path:
            return None
        with closing(sqlite3.connect(path, timeout=seconds, isolation_level=None)) as connection:
            try:
                connection.execute("BEGIN IMMEDIATE").close()
                connection.execute("ROLLBACK").close()
            except sqlite3.OperationalError as error:
                if not _is_busy(error):
                    raise
                return f"nobody can write: {_holders(Path(path))} has held SQLite's lock for over {seconds:g} s"
        return None

    def close(self) -> None:
        """Close the connections: those of the pool now, and those that a thread still uses when it lets go of them."""
        event.listen(self.engine.pool, "checkin", _close_connection)
        self.engine.dispose()


def connect(url: str, limits: str = "") -> Engine:
    """An engine with the settings that durability needs. `limits` are PostgreSQL's, as `-c name=value`."""
    if make_url(url).get_backend_name() != "sqlite":
        arguments = {**POSTGRES_LINE, "options": limits}
        return create_engine(url, pool_pre_ping=True, pool_size=10, max_overflow=20, connect_args=arguments)
    if folder := make_url(url).database:
        Path(folder).parent.mkdir(parents=True, exist_ok=True)
    # As many as a server has threads: opening a connection takes longer than a request, and they cost little when idle.
    engine = create_engine(url, pool_size=SQLITE_POOL, connect_args={"timeout": SQLITE_WAIT})
    event.listen(engine, "connect", _prepare_sqlite)
    event.listen(engine, "begin", _begin_sqlite)
    return engine


def _close_connection(_connection: Any, entry: ConnectionPoolEntry) -> None:
    entry.close()  # of the pool: whoever asks it again gets a new connection


def _prepare_sqlite(connection: Any, _record: Any) -> None:
    connection.isolation_level = None  # the driver would begin transactions on its own, and too late
    _switch_to_wal(connection)
    for pragma in ("synchronous=FULL", "foreign_keys=ON"):
        connection.execute(f"PRAGMA {pragma}").close()


def _switch_to_wal(connection: Any) -> None:
    """Of several connections that switch a new file at once SQLite lets some wait and refuses others at once."""
    give_up = time.monotonic() + SQLITE_WAIT
    while True:
        try:
            connection.execute("PRAGMA journal_mode=WAL").close()
            return
        except sqlite3.OperationalError as error:
            if not _is_busy(error) or time.monotonic() > give_up:
                raise
        time.sleep(0.01)


def _is_busy(error: sqlite3.OperationalError) -> bool:
    return error.sqlite_errorcode & 0xFF == sqlite3.SQLITE_BUSY


def _holders(path: Path) -> str:
    """Who holds the write lock, by the kernel's list of locks: a byte of the file beside the database."""
    try:
        inode = path.with_name(path.name + "-shm").stat().st_ino
        locks = [line.split() for line in Path("/proc/locks").read_text().splitlines()]
    except OSError:
        return "another process"
    # number, POSIX, ADVISORY, WRITE, process, device:inode, first byte, last byte; others that wait have "->" in front
    holders = [
        lock[4]
        for lock in locks
        if len(lock) == 8 and lock[3] == "WRITE" and lock[6] == WAL_WRITE_LOCK and lock[5].endswith(f":{inode}")
    ]
    return f"process {holders[0]}" if holders else "another process"


def _begin_sqlite(connection: Connection) -> None:
    write = connection.get_execution_options().get("write", False)
    connection.exec_driver_sql("BEGIN IMMEDIATE" if write else "BEGIN")


def upgrade_database(url: str) -> None:
    """Bring the schema up to date; safe when several servers start at once.

    One that a newer release has added to stays as it is. SchemaRefused for what this release cannot work on.
    """
    with _migration(url) as (config, schema):
        if schema.ahead:
            log.warning("a newer release has brought the schema up to date", schema=schema.revision)
        else:
            command.upgrade(config, "head")


def migrate_database(url: str, to: str) -> str | None:
    """Bring the schema up or down to a revision that this release knows. -> the one that it had.

    Down loses what only later revisions know. SchemaRefused; ValueError for a revision that there is not.
    """
    if to not in revisions():
        raise ValueError(f"there is no schema {to!r}: this release knows {', '.join(revisions())}")
    with _migration(url) as (config, schema):
        if schema.ahead:
            newest = revisions()[-1]
            raise SchemaRefused(f"only the release that made schema {schema.revision} can take it back to {newest}")
        (command.downgrade if (schema.revision or "") > to else command.upgrade)(config, to)
    return schema.revision


def read_schema(url: str) -> Schema:
    """What schema the database has now."""
    engine = connect(url)
    try:
        with engine.connect() as connection:
            return Schema.of(connection)
    finally:
        engine.dispose()


@contextmanager
def _migration(url: str) -> Iterator[tuple[Config, Schema]]:
    """For one process at a time: what alembic needs, in one transaction."""
    engine = connect(url)
    config = Config()
    config.set_main_option("script_location", str(MIGRATIONS))
    try:
        with engine.connect().execution_options(write=True) as connection, connection.begin():
            if engine.dialect.name == "postgresql":
                connection.execute(text("select pg_advisory_xact_lock(:lock)"), {"lock": MIGRATION_LOCK})
            schema = Schema.of(connection)
            schema.check()
            config.attributes["connection"] = connection
            yield config, schema
    finally:
        engine.dispose()
