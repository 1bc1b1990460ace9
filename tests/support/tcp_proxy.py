"""A line that can be cut: forwards TCP connections until it is told to swallow everything, or to break them."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from typing import Self


class TcpProxy:
    """Listens on `port` of the loopback address, forwards to `target` on the same machine. A context manager."""

    def __init__(self, target: int) -> None:
        self.target = target
        self.port = 0
        self._loop = asyncio.new_event_loop()
        self._flowing = asyncio.Event()
        self._flowing.set()
        self._lines: set[asyncio.StreamWriter] = set()
        self._tasks: set[asyncio.Task[None]] = set()
        self._thread = threading.Thread(target=self._loop.run_forever, name="proxy", daemon=True)

    def cut(self, *, silently: bool) -> None:
        """Bytes no longer get through: swallowed without a word, or with every connection broken."""
        self._call(self._cut(silently))

    def mend(self) -> None:
        """What was held back gets through, and everything that comes."""
        self._loop.call_soon_threadsafe(self._flowing.set)

    def __enter__(self) -> Self:
        self._thread.start()
        self.port = asyncio.run_coroutine_threadsafe(self._listen(), self._loop).result(10)
        return self

    def __exit__(self, *_: object) -> None:
        self._call(self._end())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    def _call(self, coroutine: object) -> None:
        asyncio.run_coroutine_threadsafe(coroutine, self._loop).result(10)  # type: ignore[arg-type]

    async def _listen(self) -> int:
        self._server = await asyncio.start_server(self._serve, "127.0.0.1", 0)
        return int(self._server.sockets[0].getsockname()[1])

    async def _cut(self, silently: bool) -> None:
        self._flowing.clear()
        if not silently:
            for writer in self._lines:
                writer.transport.abort()

    async def _end(self) -> None:
        self._server.close()
        self._flowing.set()
        for writer in list(self._lines):
            writer.transport.abort()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._tasks.add(task)
        self._lines.add(writer)
        try:
            await self._flowing.wait()
            away_reader, away_writer = await asyncio.open_connection("127.0.0.1", self.target)
            self._lines.add(away_writer)
            await asyncio.gather(self._pump(reader, away_writer), self._pump(away_reader, writer))
            self._lines.discard(away_writer)
        except OSError:
            writer.transport.abort()
        finally:
            self._lines.discard(writer)
            self._tasks.discard(task)

    async def _pump(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError):
            while chunk := await reader.read(1 << 16):
                await self._flowing.wait()
                writer.write(chunk)
                await writer.drain()
        with contextlib.suppress(OSError):
            writer.close()
