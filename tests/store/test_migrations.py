"""Databases that hold something, up and down through every revision; and what a migration may do to one."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import databases
import pytest
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from sqlalchemy import inspect

from advtex_contract.jobs import TERMINAL, JobSpec
from advtex_store.accounts import Accounts
from advtex_store.batches import Batches
from advtex_store.checks import Checks
from advtex_store.counters import Counters
from advtex_store.database import Database, connect, migrate_database, read_schema, upgrade_database
from advtex_store.errors import SchemaRefused
from advtex_store.models import Base
from advtex_store.overviews import Overviews
from advtex_store.records import Records
from advtex_store.schema import GENERATION_DIGITS, revisions
from advtex_store.submissions import JobFilter, Submissions
from advtex_store.uploads import Uploads

REVISIONS = revisions()
HEAD = REVISIONS[-1]


def described(url: str) -> dict[str, Any]:
    """Tables with their columns and indexes, whatever order they came in."""
    engine = connect(url)
    found: dict[str, Any] = {}
    with engine.connect() as connection:
        look = inspect(connection)
        for table in databases.tables(connection):
            columns = {c["name"]: (str(c["type"]), c["nullable"], c["default"]) for c in look.get_columns(table.name)}
            indexes = {i["name"]: i["column_names"] for i in look.get_indexes(table.name)}
            found[table.name] = (columns, indexes, look.get_pk_constraint(table.name)["constrained_columns"])
    engine.dispose()
    return found


def part_of(rows: databases.Rows, like: databases.Rows) -> databases.Rows:
    """The same tables and columns as in `like`."""
    columns = {table: set(found[0]) for table, found in like.items()}
    return {
        table: [{name: value for name, value in row.items() if name in columns[table]} for row in rows[table]]
        for table in like
    }


def ordered(rows: databases.Rows) -> dict[str, list[str]]:
    return {table: sorted(repr(sorted(row.items())) for row in found) for table, found in rows.items()}


def check_works(url: str) -> None:
    """The schema is the models', and what was there can be read and gone on with."""
    engine = connect(url)
    with engine.connect() as connection:
        context = MigrationContext.configure(connection, opts={"compare_type": True})
        assert compare_metadata(context, Base.metadata) == []
    engine.dispose()
    database = Database(url)
    submissions, records = Submissions(database), Records(database)
    jobs, _ = submissions.list_jobs("ada")
    states = {job.state for job in jobs}
    assert states >= {"queued", "running", "preempted", "succeeded", "failed", "rejected"}
    assert {job.id for job in Overviews(database).jobs("ada", JobFilter(), None, 50)[0]} == {job.id for job in jobs}
    for batch in {job.batch for job in jobs if job.batch}:
        assert Batches(database).batch("ada", batch).states
    assert Accounts(database).usage("ada").active_jobs == sum(job.state not in TERMINAL for job in jobs)
    assert Counters(database).load().oldest_seconds > 0
    assert Uploads(database).find("ada", "ab" * 32) is not None
    assert {job.state for job in records.waiting(10)} == {"queued", "preempted"}
    database.close()


def go_on(url: str) -> None:
    """A new job, and the end of one that waited."""
    database = Database(url)
    records = Records(database)
    (upload, *_) = [row["id"] for row in databases.read(url)["uploads"] if row["sha256"] and not row["deleted_at"]]
    made = Submissions(database).create_job("ada", JobSpec(upload_id=upload))
    checks = Checks(records)
    while (checked := checks.claim()) is not None:
        checks.passed(checked, [], 0)
    for job in records.waiting(10):
        claim = records.claim(job.id, job.attempt, "test")
        records.canceled(job.id, claim.attempt)
    assert records.job(made.id).state == "canceled"
    database.close()


@pytest.mark.parametrize("revision", REVISIONS)
def test_every_revision_has_a_populated_database(revision: str, sqlite_url: str) -> None:
    path = databases.FOLDER / f"{revision}.json"
    assert path.exists(), f"begin it with: python {databases.__file__} {revision}"
    url = sqlite_url.replace("test.db", "kept.db")
    rows = databases.load(url, revision)
    columns = {table: set(found) for table, (found, _, _) in described(url).items()}
    filled = {table: {n for row in found for n, v in row.items() if v is not None} for table, found in rows.items()}
    assert filled == columns, "rows for every table, and values for every column"


def test_there_is_no_database_of_a_revision_that_is_gone() -> None:
    assert {path.stem for path in databases.FOLDER.glob("*.json")} == set(REVISIONS)


@pytest.mark.parametrize("revision", REVISIONS)
def test_a_populated_database_goes_up_and_down_and_up_again(revision: str, empty_url: str) -> None:
    before = databases.load(empty_url, revision)
    schema = described(empty_url)
    upgrade_database(empty_url)
    after = databases.read(empty_url)
    assert ordered(part_of(after, before)) == ordered(before), "a migration changed what was there"
    check_works(empty_url)
    assert migrate_database(empty_url, revision) == HEAD
    assert described(empty_url) == schema
    assert ordered(databases.read(empty_url)) == ordered(before), "what this revision knows was lost on the way"
    upgrade_database(empty_url)
    assert read_schema(empty_url).revision == HEAD
    check_works(empty_url)
    go_on(empty_url)


def test_a_job_that_is_checked_waits_where_jobs_are_not_checked(empty_url: str) -> None:
    """A release from before reads its scan in the worker, and rejects it there."""
    (checked,) = [job for job in databases.load(empty_url, "0006")["jobs"] if job["state"] == "checking"]
    migrate_database(empty_url, "0005")
    (job,) = [job for job in databases.read(empty_url)["jobs"] if job["id"] == checked["id"]]
    assert (job["state"], job["attempt"], job["worker"], job["deaths"]) == ("queued", checked["attempt"] + 1, None, 0)


@pytest.mark.parametrize(("earlier", "later"), list(pairwise(REVISIONS)))
def test_migrations_of_a_generation_only_add(earlier: str, later: str, empty_url: str) -> None:
    """Else servers and workers of the release before could not go on while the others are upgraded."""
    if earlier[:GENERATION_DIGITS] != later[:GENERATION_DIGITS]:
        pytest.skip("a new generation: no older release works on it")
    migrate_database(empty_url, earlier)
    before = described(empty_url)
    migrate_database(empty_url, later)
    after = described(empty_url)
    engine = connect(empty_url)
    with engine.connect() as connection:
        tables = {table.name: table for table in databases.tables(connection)}
    engine.dispose()
    for table, (columns, _, key) in before.items():
        assert after[table][2] == key
        for name, column in columns.items():
            assert after[table][0].get(name) == column, f"{later} changes {table}.{name}"
        for column in tables[table].columns:
            filled = column.nullable or column.server_default is not None or column.computed is not None
            assert column.name in columns or filled, f"{later}: older code does not know {table}.{column.name}"
    for table in set(after) - set(before):
        for key in tables[table].foreign_keys:
            assert key.ondelete in ("CASCADE", "SET NULL"), f"{later}: older code cannot delete what {table} refers to"


def test_a_schema_that_a_newer_release_has_added_to_is_worked_on(empty_url: str) -> None:
    """As it is while a fleet is upgraded, and after a rollback."""
    databases.load(empty_url, HEAD)
    newer = f"{HEAD[:GENERATION_DIGITS]}99"
    databases.give_revision(empty_url, newer)
    upgrade_database(empty_url)
    found = read_schema(empty_url)
    found.check()
    assert (found.revision, found.ahead, found.behind) == (newer, True, None)
    with pytest.raises(SchemaRefused, match="only the release that made schema"):
        migrate_database(empty_url, HEAD)
    go_on(empty_url)


@pytest.mark.parametrize("revision", ["9901", f"{HEAD[:GENERATION_DIGITS]}00", "ae1027a6acf"])
def test_a_schema_that_is_not_known_is_refused_with_a_sentence(revision: str, empty_url: str) -> None:
    """Of a new generation, or of somebody else."""
    upgrade_database(empty_url)
    databases.give_revision(empty_url, revision)
    with pytest.raises(SchemaRefused, match=f"has schema {revision}, which this release does not know"):
        upgrade_database(empty_url)
    with pytest.raises(SchemaRefused):
        read_schema(empty_url).check()
    assert read_schema(empty_url).revision == revision


def test_a_schema_that_is_behind_says_who_brings_it_up_to_date(empty_url: str) -> None:
    assert "is empty" in str(read_schema(empty_url).behind)
    migrate_database(empty_url, REVISIONS[0])
    found = read_schema(empty_url)
    found.check()
    assert f"has schema {REVISIONS[0]} and this release needs {HEAD}" in str(found.behind)
    upgrade_database(empty_url)
    assert read_schema(empty_url).behind is None


def test_only_known_revisions_can_be_asked_for(sqlite_url: str) -> None:
    with pytest.raises(ValueError, match="this release knows 0001, 0002"):
        migrate_database(sqlite_url, "0000")
