"""Knows callers by their keys, and lets nobody try keys without end."""

from __future__ import annotations

import hashlib
import math
import time
from collections import OrderedDict
from collections.abc import Callable
from typing import TypeVar

from starlette.concurrency import run_in_threadpool

from advtex_contract.errors import ErrorCode, ErrorDetail
from advtex_server.refusal import ApiError
from advtex_store.accounts import Accounts, Caller

K = TypeVar("K")
V = TypeVar("V")
KNOWN_SECONDS = 2.0  # a key is looked up this often at most; a revoked one works so much longer
REMEMBERED = 10_000  # keys, and addresses that failed


class Authenticator:
    """`failures_per_minute`: wrong keys from one address; beyond it the address is refused without a look, except for
    keys that are known to be good."""

    def __init__(
        self, accounts: Accounts, failures_per_minute: int, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._accounts = accounts
        self._limit = failures_per_minute
        self._clock = clock
        self._known: OrderedDict[bytes, tuple[Caller, float]] = OrderedDict()
        self._failed: OrderedDict[str, tuple[float, float]] = OrderedDict()  # failures that count still, since when

    async def caller(self, authorization: str, address: str) -> Caller:
        """Who sends this header from this address. ApiError 401, or 429 after too many wrong keys."""
        kind, _, key = authorization.partition(" ")
        key = key.strip()
        if kind.lower() != "bearer" or not key:
            raise unauthorized("there is no key", "send yours as 'Authorization: Bearer adv_…'")
        digest = hashlib.sha256(key.encode()).digest()
        known = self._known.get(digest)
        if known is None:
            self._refuse_after_many_failures(address)
        elif known[1] > self._clock():
            return known[0]
        caller = await run_in_threadpool(self._accounts.authenticate, key)
        if caller is None:
            self._known.pop(digest, None)
            remember(self._failed, address, (self._counted(address) + 1, self._clock()))
            raise unauthorized(
                "the key is unknown, revoked or expired", "ask for a new one; `advtex-server keys create` makes it"
            )
        remember(self._known, digest, (caller, self._clock() + KNOWN_SECONDS))
        return caller

    def _refuse_after_many_failures(self, address: str) -> None:
        excess = self._counted(address) + 1 - self._limit
        if excess > 0:
            seconds = math.ceil(excess * 60.0 / self._limit)
            message = f"too many wrong keys came from {address}; try again in {seconds} s"
            raise ApiError(ErrorCode.rate_limited, message, headers={"Retry-After": str(seconds)})

    def _counted(self, address: str) -> float:
        """Failures, forgotten one by one over a minute."""
        count, since = self._failed.get(address, (0.0, 0.0))
        return max(0.0, count - (self._clock() - since) * self._limit / 60.0)


def remember(entries: OrderedDict[K, V], key: K, value: V) -> None:
    """As the newest of REMEMBERED entries."""
    entries[key] = value
    entries.move_to_end(key)
    if len(entries) > REMEMBERED:
        entries.popitem(last=False)


def unauthorized(message: str, remedy: str) -> ApiError:
    """401, in words."""
    detail = ErrorDetail(code="bad_key", where="Authorization", message=message, remedy=remedy)
    return ApiError(ErrorCode.unauthorized, f"{message}: {remedy}", [detail])
