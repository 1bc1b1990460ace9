"""What works and what does not, in words."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from dataclasses import dataclass

from redis import RedisError
from sqlalchemy import text
from sqlalchemy.exc import SQLAlchemyError

from advtex_server.loops import Loop
from advtex_server.settings import ServerSettings
from advtex_store.errors import SchemaRefused, StoreError
from advtex_store.schema import Schema
from advtex_store.store import Store
from advtex_store.troubles import ROUNDS

NAMED_TROUBLES = 5


@dataclass(frozen=True, slots=True)
class Check:
    """One part: whether it works, whether the service can do without it for a while, and what is wrong."""

    name: str
    ok: bool
    essential: bool
    message: str = ""


def checks(store: Store, settings: ServerSettings, loops: Sequence[Loop] = ()) -> list[Check]:
    """Look at database, blobs, disk, queue, workers, what housekeeping could not do, and what this process does in the
    background, if it does anything."""
    found = [_database(store), _blobs(store), _disk(store, settings), _redis(store), _workers(store), _troubles(store)]
    return [*found, _background(loops)] if loops else found


def _database(store: Store) -> Check:
    try:
        with store.database.read() as session:
            schema = Schema.of(session.connection())
            schema.check()
            if schema.behind is None:
                session.execute(text("select id from jobs limit 1"))
        blocked = store.database.blocked()
    except SchemaRefused as error:
        return Check("database", False, True, str(error))
    except (SQLAlchemyError, sqlite3.Error) as error:
        return Check("database", False, True, f"the database does not answer: {_first_line(error)}")
    if schema.behind is not None:
        return Check("database", False, True, schema.behind)
    if blocked is not None:
        return Check("database", False, True, f"{blocked}: if it is frozen, let it go on or end it")
    return Check("database", True, True)


def _blobs(store: Store) -> Check:
    try:
        store.blobs.check()
    except StoreError as error:
        return Check("blobs", False, True, str(error))
    return Check("blobs", True, True)


def _disk(store: Store, settings: ServerSettings) -> Check:
    try:
        free = store.blobs.free_bytes()
    except OSError as error:
        return Check("disk", False, True, f"the disk cannot be read: {error}")
    if free < settings.disk_reserve_bytes:
        message = f"{free >> 20} MiB are free, uploads need {settings.disk_reserve_bytes >> 20} MiB: make room"
        return Check("disk", False, True, message)
    return Check("disk", True, True)


def _redis(store: Store) -> Check:
    try:
        store.queue.redis.ping()
    except (RedisError, OSError) as error:
        return Check("redis", False, False, f"Redis does not answer, jobs are accepted and wait: {_first_line(error)}")
    return Check("redis", True, False)


def _workers(store: Store) -> Check:
    try:
        living = store.queue.workers()
    except (RedisError, OSError):
        return Check("workers", False, False, "not known while Redis does not answer")
    if not living:
        return Check("workers", False, False, "no worker is running, jobs are accepted and wait: start advtex-worker")
    try:
        pauses = store.counters.pauses()
    except SQLAlchemyError:  # told by its own check
        pauses = []
    if pauses:
        return Check("workers", False, False, f"{len(living)} running; {'; '.join(pauses)}")
    return Check("workers", True, False, f"{len(living)} running")


def _troubles(store: Store) -> Check:
    try:
        found = store.troubles.all()
    except SQLAlchemyError:
        return Check("housekeeping", False, False, "not known while the database does not answer")
    told = [f"{row.task} {row.item} {_rounds(row.rounds)}: {row.error}" for row in found[:NAMED_TROUBLES]]
    if len(found) > NAMED_TROUBLES:
        told.append(f"and {len(found) - NAMED_TROUBLES} more")
    return Check("housekeeping", not told, False, "; ".join(told))


def _background(loops: Sequence[Loop]) -> Check:
    told = [loop.trouble for loop in loops if loop.trouble]
    return Check("background", not told, False, "; ".join(told))


def _rounds(rounds: int) -> str:
    return f"failed {rounds} times" + (" and is set aside for a day" if rounds >= ROUNDS else "")


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
