"""Delivers webhooks from their outbox. A receiver that is slow or dead costs nobody else anything: each webhook has one
try at a time, and pauses longer after every one that fails."""

from __future__ import annotations

import asyncio
import ssl
from collections.abc import Callable
from datetime import UTC, datetime
from functools import partial

import httpx
import structlog
from sqlalchemy.exc import SQLAlchemyError
from standardwebhooks import Webhook
from starlette.concurrency import run_in_threadpool

from advtex_server.loops import Loop
from advtex_server.settings import ServerSettings
from advtex_server.targets import TargetRefused, TargetRules
from advtex_store.tracing import OFF, Traces
from advtex_store.webhooks import Delivery, Webhooks

LOOK_SECONDS = 1.0
ANSWER_SECONDS = 15.0  # for looking up, connecting and answering; less than TRY_SECONDS of the outbox
AT_ONCE = 16

log = structlog.get_logger("advtex.webhooks")


class Deliverer:
    """One task; any number of servers may run one. count: told of each try whether it was `delivered` or `failed`."""

    def __init__(
        self,
        webhooks: Webhooks,
        settings: ServerSettings,
        count: Callable[[str], None] = lambda _outcome: None,
        traces: Traces = OFF,
    ) -> None:
        self.webhooks = webhooks
        self._count = count
        self._traces = traces
        self.rules = rules(settings)
        self.loop = Loop("webhooks")
        self._running: dict[str, asyncio.Task[None]] = {}
        self._opened: httpx.AsyncClient | None = None

    async def run(self) -> None:
        """Until canceled. A try that is cut off then is made again."""
        try:
            while True:
                with self.loop.turn():
                    await self._begin()
                await asyncio.sleep(LOOK_SECONDS)
        finally:
            for task in self._running.values():
                task.cancel()
            if self._opened is not None:
                await self._opened.aclose()

    def _client(self) -> httpx.AsyncClient:
        """Made by the first turn that can: it reads files of the system."""
        if self._opened is None:
            # No proxies from the environment, which would look names up again; no redirects, which lead elsewhere.
            context = ssl.create_default_context()
            self._opened = httpx.AsyncClient(
                verify=context, trust_env=False, follow_redirects=False, timeout=ANSWER_SECONDS
            )
        return self._opened

    async def _begin(self) -> None:
        client = self._client()
        for delivery in await run_in_threadpool(
            self.webhooks.take_due, AT_ONCE - len(self._running), set(self._running)
        ):
            task = asyncio.create_task(self._attempt(client, delivery))
            self._running[delivery.webhook_id] = task
            task.add_done_callback(partial(self._ended, delivery.webhook_id))

    def _ended(self, webhook_id: str, _task: asyncio.Task[None]) -> None:
        del self._running[webhook_id]

    async def _attempt(self, client: httpx.AsyncClient, delivery: Delivery) -> None:
        bound = log.bind(webhook=delivery.webhook_id, delivery=delivery.id)
        try:
            parent = await run_in_threadpool(self.webhooks.traceparent, delivery) if self._traces.on else None
            span = self._traces.span("webhook", parent, webhook=delivery.webhook_id, delivery=delivery.id)
            error, gone = await self._send(client, delivery, span.traceparent)
            span.end(error)
            self._count("failed" if error else "delivered")
            if not error:
                await run_in_threadpool(self.webhooks.delivered, delivery)
                bound.info("delivered")
                return
            disabled = await run_in_threadpool(self.webhooks.failed, delivery, error, gone=gone)
            bound.warning("not delivered", error=error, disabled=disabled)
        except SQLAlchemyError as trouble:
            bound.warning("the outcome is not recorded, it will be sent again", error=str(trouble))
        except Exception:
            bound.exception("the outcome is not recorded, it will be sent again")

    async def _send(self, client: httpx.AsyncClient, delivery: Delivery, traceparent: str | None) -> tuple[str, bool]:
        """-> what went wrong, if anything, and whether the receiver wants nothing more."""
        now = datetime.now(UTC)
        try:
            async with asyncio.timeout(ANSWER_SECONDS):
                target = await run_in_threadpool(self.rules.resolve, delivery.url)
                headers = {
                    "Host": target.host_header,
                    "Content-Type": "application/json",
                    "User-Agent": "advtex",
                    "webhook-id": delivery.id,
                    "webhook-timestamp": str(int(now.timestamp())),
                    "webhook-signature": Webhook(delivery.secret).sign(delivery.id, now, delivery.body),
                    **({} if traceparent is None else {"traceparent": traceparent}),
                }
                request = client.build_request(
                    "POST",
                    target.url,
                    content=delivery.body.encode(),
                    headers=headers,
                    extensions={"sni_hostname": target.host},
                )
                response = await client.send(request, stream=True)
                await response.aclose()  # what it says beyond the status is not read
        except TargetRefused as refusal:
            return f"the address is refused: {refusal}", False
        except (httpx.HTTPError, OSError, TimeoutError) as error:
            return f"{type(error).__name__}: {error}".rstrip(": "), False
        except Exception as fault:  # of its address or its secret, most likely: no reason to try it for ever
            log.exception("a delivery failed", webhook=delivery.webhook_id, delivery=delivery.id)
            return f"it cannot be sent: the server failed ({type(fault).__name__})", False
        if response.is_success:
            return "", False
        redirected = "; redirects are not followed" if response.is_redirect else ""
        return f"it answered {response.status_code}{redirected}", response.status_code == 410


def rules(settings: ServerSettings) -> TargetRules:
    """As the operator has set them."""
    return TargetRules(allow_http=settings.webhook_allow_http, networks=settings.webhook_networks)
