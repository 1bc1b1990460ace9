"""A process that is frozen while it writes to SQLite: others wait for a bounded time, and are told of it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import text

from advtex_server.health import checks
from advtex_server.settings import ServerSettings
from advtex_store.store import Store, open_store

FROZEN = """
import sqlite3, sys, time
connection = sqlite3.connect(sys.argv[1], isolation_level=None)
connection.execute("BEGIN IMMEDIATE")
print("holds", flush=True)
time.sleep(600)
"""


@pytest.fixture
def store(sqlite_url: str, redis_url: str, tmp_path: Path) -> Iterator[Store]:
    opened = open_store(ServerSettings(database_url=sqlite_url, redis_url=redis_url, data_dir=tmp_path))
    yield opened
    opened.close()


@pytest.fixture
def frozen(sqlite_url: str, store: Store) -> Iterator[subprocess.Popen[bytes]]:
    with store.database.write():
        pass  # one connection stays open: the files beside the database are there
    path = sqlite_url.removeprefix("sqlite:///")
    process = subprocess.Popen([sys.executable, "-c", FROZEN, path], stdout=subprocess.PIPE)
    assert process.stdout is not None
    assert process.stdout.readline() == b"holds\n"
    os.kill(process.pid, signal.SIGSTOP)
    yield process
    process.kill()
    process.wait()
    process.stdout.close()


def database(store: Store) -> Any:
    assert isinstance(store.settings, ServerSettings)
    (check,) = [check for check in checks(store, store.settings) if check.name == "database"]
    return check


def test_a_frozen_writer_is_named_and_gone_when_it_is_ended(store: Store, frozen: subprocess.Popen[bytes]) -> None:
    began = time.monotonic()
    check = database(store)
    assert time.monotonic() - began < 15
    assert (check.ok, check.essential) == (False, True)
    if sys.platform == "linux":
        assert f"process {frozen.pid} has held SQLite's lock for over 5 s" in check.message
    frozen.kill()
    frozen.wait()
    check = database(store)
    assert check.ok, check.message


def test_a_writer_that_takes_its_time_is_no_trouble(store: Store) -> None:
    with store.database.write() as session:
        session.execute(text("select 1"))  # the transaction begins with its first statement
        assert store.database.blocked(0.1) is not None
    assert store.database.blocked(0.1) is None
