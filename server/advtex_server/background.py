"""What a service does beside answering requests: dispatch and put right, check scans, deliver webhooks.

Any number of processes may do it at once, servers or dispatchers alone; one at least has to.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress

from advtex_server.checking import Checker
from advtex_server.deliveries import Deliverer
from advtex_server.dispatch import Dispatcher
from advtex_server.loops import Loop
from advtex_server.metrics import Metrics
from advtex_server.settings import ServerSettings
from advtex_store.store import Store
from advtex_store.tracing import OFF, Traces


class Background:
    """All of it, on one store."""

    def __init__(self, store: Store, settings: ServerSettings, metrics: Metrics, traces: Traces = OFF) -> None:
        self._dispatcher = Dispatcher(store, settings, metrics.round, traces)
        self._checker = Checker(store, settings, self._dispatcher.wake, traces)
        self._deliverer = Deliverer(store.webhooks, settings, metrics.delivered, traces)
        metrics.watch(self.loops)

    @property
    def loops(self) -> tuple[Loop, ...]:
        """All that goes on while it is `running`."""
        return (*self._dispatcher.loops, *self._checker.loops, self._deliverer.loop)

    def wake(self) -> None:
        """From any thread: look now."""
        self._checker.wake()
        self._dispatcher.wake()

    @asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Work for as long as the block lasts."""
        tasks = [asyncio.create_task(self._dispatcher.run()), asyncio.create_task(self._deliverer.run())]
        self._checker.start()
        try:
            yield
        finally:
            for task in tasks:
                task.cancel()
                with suppress(asyncio.CancelledError):
                    await task
            await asyncio.to_thread(self._checker.stop)
