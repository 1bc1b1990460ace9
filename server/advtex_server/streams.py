"""Streams that last longer than the right to follow them."""

from __future__ import annotations

import time
from collections.abc import AsyncIterator, Awaitable, Callable

from sqlalchemy.exc import SQLAlchemyError

from advtex_server.refusal import ApiError
from advtex_store.accounts import Caller

ASK_SECONDS = 10.0  # between two looks at who follows a stream


async def while_welcome(events: AsyncIterator[str], ask: Callable[[], Awaitable[Caller | None]]) -> AsyncIterator[str]:
    """The events, until the key that opened the stream is revoked or expires, or the session ends.

    ask: who follows, from the database; None or ApiError: nobody any more. While the database is away nothing ends.
    """
    asked = time.monotonic()
    async for event in events:
        if time.monotonic() - asked > ASK_SECONDS:
            try:
                caller = await ask()
            except ApiError:
                return
            except SQLAlchemyError:
                pass
            else:
                if caller is None or "read" not in caller.scopes:
                    return
                asked = time.monotonic()
        yield event
