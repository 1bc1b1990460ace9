"""A store with a clock that tests set."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import psycopg
import pytest

from advtex_contract.jobs import JobSpec
from advtex_store.accounts import Accounts
from advtex_store.batches import Batches
from advtex_store.checks import Checks
from advtex_store.database import Database
from advtex_store.records import Records
from advtex_store.submissions import Submissions
from advtex_store.uploads import Uploads

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

OWNER = "someone"


@dataclass
class Clock:
    """Seconds since 1970, moved by hand."""

    now: float = 1_700_000_000.0

    def __call__(self) -> float:
        return self.now


@dataclass
class Bench:
    """Everything in the database, and shortcuts."""

    database: Database
    clock: Clock
    owner: str = OWNER
    records: Records = field(init=False)
    checks: Checks = field(init=False)
    uploads: Uploads = field(init=False)
    submissions: Submissions = field(init=False)
    batches: Batches = field(init=False)
    accounts: Accounts = field(init=False)

    def __post_init__(self) -> None:
        self.records = Records(self.database, lease_seconds=60)
        self.checks = Checks(self.records)
        self.uploads = Uploads(self.database, retention_seconds=1000)
        self.submissions = Submissions(self.database, retention_seconds=1000)
        self.batches = Batches(self.database)
        self.accounts = Accounts(self.database)

    def finished_upload(self, owner: str = OWNER) -> str:
        row = self.uploads.create(owner, 3, "scan.zip")
        return self.uploads.finish(row.id, "ab" * 32).id

    def job(self, owner: str = OWNER, **spec: object) -> str:
        if "source" not in spec:
            spec.setdefault("upload_id", self.finished_upload(owner))
        from checked import queued_job

        return queued_job(self, owner, JobSpec.model_validate(spec))

    def state(self, job_id: str) -> tuple[str, int]:
        row = self.records.job(job_id)
        return row.state, row.attempt


@pytest.fixture(params=["sqlite", "postgresql"])
def empty_url(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[str]:
    """A database without a schema, of either kind."""
    if request.param == "sqlite":
        yield f"sqlite:///{tmp_path}/empty.db"
        return
    server, name = str(request.getfixturevalue("postgres_server")), "empty_" + os.urandom(6).hex()
    with psycopg.connect(server + "postgres", autocommit=True) as connection:
        connection.execute(f"create database {name}")
        yield f"{server}{name}".replace("postgresql:", "postgresql+psycopg:")
        connection.execute(f"drop database {name} with (force)")


@pytest.fixture
def bench(database_url: str) -> Iterator[Bench]:
    clock = Clock()
    database = Database(database_url, clock)
    yield Bench(database, clock)
    database.close()


@pytest.fixture
def sqlite_bench(sqlite_url: str) -> Iterator[Bench]:
    """For tests that make hundreds of rows."""
    clock = Clock()
    database = Database(sqlite_url, clock)
    yield Bench(database, clock)
    database.close()


@pytest.fixture
def small_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Parts of multipart uploads are as small as scans of a few bytes need."""
    import moto.s3.models

    monkeypatch.setattr("advtex_store.s3_partial.PART", 8)
    monkeypatch.setattr(moto.s3.models, "S3_UPLOAD_PART_MIN_SIZE", 8)
