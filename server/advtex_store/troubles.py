"""What housekeeping could not do for single jobs and uploads: it goes on with the others and, in the end, leaves these.

One row per task and item, shared by all servers. An item that failed ROUNDS times in a row is set aside: no task looks
at it for ASIDE_SECONDS, and then once more.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import structlog
from sqlalchemy import ColumnElement, and_, case, delete, func, select
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.exc import DBAPIError
from sqlalchemy.orm import InstrumentedAttribute

from advtex_store.blobs import Blobs
from advtex_store.database import Database
from advtex_store.errors import NoSpace
from advtex_store.models import TroubleRow

ADOPT, PURGE, TIDY, SWEEP = "adopt", "purge", "tidy", "sweep"
ROUNDS = 10
ASIDE_SECONDS = 86400.0
ERROR_LENGTH = 1000

log = structlog.get_logger("advtex.housekeeping")


class Troubles:
    """Which items fail, why, and for how many rounds."""

    def __init__(self, database: Database, blobs: Blobs) -> None:
        self.database = database
        self.blobs = blobs

    @contextmanager
    def of(self, task: str, item: str) -> Iterator[None]:
        """What fails inside is the item's own trouble: it is noted, and the task goes on.

        Raised is what no other item would be spared: a database that does not answer, a storage that fails its check
        (BlobsUnavailable), a full disk (NoSpace).
        """
        try:
            yield
        except (DBAPIError, NoSpace):
            raise
        except Exception as error:
            self.blobs.check()
            rounds = self._failed(task, item, f"{type(error).__name__}: {error}")
            log.warning("housekeeping failed", task=task, item=item, rounds=rounds, error=str(error))
        else:
            if item in self._known(task):
                self.forget(task, item)

    def all(self) -> list[TroubleRow]:
        """The longest first."""
        with self.database.read() as session:
            return list(session.scalars(select(TroubleRow).order_by(TroubleRow.rounds.desc(), TroubleRow.item)))

    def counts(self) -> dict[tuple[str, bool], int]:
        """How many items by task, and by whether they are set aside."""
        with self.database.read() as session:
            aside = case((TroubleRow.rounds >= ROUNDS, 1), else_=0)
            query = select(TroubleRow.task, aside, func.count()).group_by(TroubleRow.task, aside)
            return {(task, bool(done)): int(count) for task, done, count in session.execute(query)}

    def aside(self, task: str) -> set[str]:
        """The items that the task is not to look at."""
        with self.database.read() as session:
            return set(session.scalars(select(TroubleRow.item).where(_aside(task, self.database.now(session)))))

    def forget(self, task: str, item: str) -> None:
        with self.database.write() as session:
            session.execute(delete(TroubleRow).where(TroubleRow.task == task, TroubleRow.item == item))

    def _known(self, task: str) -> set[str]:
        with self.database.read() as session:
            return set(session.scalars(select(TroubleRow.item).where(TroubleRow.task == task)))

    def _failed(self, task: str, item: str, error: str) -> int:
        with self.database.write() as session:
            now = self.database.now(session)
            insert = sqlite.insert if session.get_bind().dialect.name == "sqlite" else postgresql.insert
            values = {"task": task, "item": item, "rounds": 1, "error": error[:ERROR_LENGTH]}
            statement = insert(TroubleRow).values(**values, first_at=now, last_at=now)
            changed = {"rounds": TroubleRow.rounds + 1, "error": values["error"], "last_at": now}
            statement = statement.on_conflict_do_update(index_elements=["task", "item"], set_=changed)
            return int(session.scalar(statement.returning(TroubleRow.rounds)) or 0)


def not_aside(task: str, item: InstrumentedAttribute[str], now: float) -> ColumnElement[bool]:
    """The items that the task is to look at."""
    return item.not_in(select(TroubleRow.item).where(_aside(task, now)))


def _aside(task: str, now: float) -> ColumnElement[bool]:
    return and_(TroubleRow.task == task, TroubleRow.rounds >= ROUNDS, TroubleRow.last_at > now - ASIDE_SECONDS)
