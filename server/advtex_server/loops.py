"""What a service does again and again in the background, and how each of these fares."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime

import structlog
from redis import RedisError
from sqlalchemy.exc import SQLAlchemyError

from advtex_store.errors import StoreError

OUTAGES = (RedisError, SQLAlchemyError, StoreError, OSError)
"""Of a part that the service leans on: the message says which, and no traceback would say more."""

log = structlog.get_logger("advtex.loops")


class Loop:
    """One of them. It does everything inside `turn`, so that nothing that fails ends it, and none of it goes unseen.

    name: one of a few, for people and metrics.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self._failing_since: float | None = None
        self._error = ""

    @contextmanager
    def turn(self) -> Iterator[None]:
        """Another turn follows, whatever happens in this one. Of failures in a row the first is logged, and those that
        nobody expects with their tracebacks, each."""
        try:
            yield
        except Exception as error:
            told = self._failing_since is not None
            self._failing_since = self._failing_since or time.time()
            self._error = f"{type(error).__name__}: {error}"
            if not isinstance(error, OUTAGES):
                log.exception("a loop failed, and goes on", loop=self.name)
            elif not told:
                log.warning("a loop cannot work, and tries again", loop=self.name, error=self._error)
        else:
            if self._failing_since is not None:
                log.info("a loop works again", loop=self.name)
            self._failing_since = None

    @property
    def failing_seconds(self) -> float:
        """For how long no turn has gone well; 0 where the last one has."""
        since = self._failing_since
        return 0.0 if since is None else time.time() - since

    @property
    def trouble(self) -> str:
        """What is wrong, in words; empty where nothing is."""
        since = self._failing_since
        if since is None:
            return ""
        return f"{self.name} has failed since {datetime.fromtimestamp(since, UTC):%Y-%m-%d %H:%M:%S} UTC: {self._error}"
