"""Request bodies of uploads: read with a limit on silence, one at a time per upload, the newest one wins."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, AsyncIterator
from contextlib import asynccontextmanager, suppress

from starlette.concurrency import run_in_threadpool

from advtex_contract.errors import ErrorCode
from advtex_server.intake import Receiving
from advtex_server.refusal import ApiError
from advtex_store.errors import Superseded

BUFFER = 1 << 20  # bytes handed to the storage at a time


class OpenBody:
    """The body that is arriving for one upload."""

    def __init__(self, upload_id: str) -> None:
        self.ended = asyncio.Event()
        self._upload_id = upload_id
        self._superseded = False
        self._waiting: asyncio.Timeout | None = None

    def supersede(self) -> None:
        """Read no more of it."""
        self._superseded = True
        if self._waiting is not None:
            self._waiting.reschedule(asyncio.get_running_loop().time())

    async def chunks(self, stream: AsyncGenerator[bytes, None], idle_seconds: float) -> AsyncIterator[bytes]:
        """Until the end. Superseded; ApiError when nothing comes for too long: a half-open line would stay for ever."""
        while not self._superseded:
            try:
                async with asyncio.timeout(idle_seconds) as self._waiting:
                    chunk = await anext(stream, None)
            except TimeoutError:
                if self._superseded:
                    break
                raise ApiError(ErrorCode.bad_request, f"nothing came for {idle_seconds:g} s", status=408) from None
            finally:
                self._waiting = None
            if chunk is None:
                return
            yield chunk
        raise Superseded(f"a newer request goes on with upload {self._upload_id}")


class OpenBodies:
    """The bodies that arrive in this server process. A request in another one learns of its end from the row."""

    def __init__(self) -> None:
        self._open: dict[str, OpenBody] = {}

    async def end(self, upload_id: str, patience: float) -> None:
        """End the body that is arriving for an upload, and wait until what came of it is kept."""
        body = self._open.get(upload_id)
        if body is not None:
            await _ended(body, patience)

    @asynccontextmanager
    async def alone(self, upload_id: str, patience: float) -> AsyncIterator[OpenBody]:
        """The newest body of an upload."""
        mine = OpenBody(upload_id)
        older, self._open[upload_id] = self._open.get(upload_id), mine
        try:
            if older is not None:
                await _ended(older, patience)
            yield mine
        finally:
            mine.ended.set()
            if self._open.get(upload_id) is mine:
                del self._open[upload_id]


async def _ended(body: OpenBody, patience: float) -> None:
    body.supersede()
    with suppress(TimeoutError):  # it loses the row in any case
        await asyncio.wait_for(body.ended.wait(), patience)


async def receive(body: OpenBody, stream: AsyncGenerator[bytes, None], receiving: Receiving, idle: float) -> None:
    """Write the body as it comes. Whatever ends it early, what came is kept."""
    buffer = bytearray()
    try:
        async for chunk in body.chunks(stream, idle):
            buffer += chunk
            if len(buffer) >= BUFFER:
                piece = bytes(buffer)
                buffer.clear()
                await run_in_threadpool(receiving.write, piece)
        if buffer:
            await run_in_threadpool(receiving.write, bytes(buffer))
    except Exception:
        await run_in_threadpool(receiving.abandon, bytes(buffer))
        raise
    except BaseException:
        receiving.abandon(bytes(buffer))  # inline: a canceled task could not wait for a thread
        raise
