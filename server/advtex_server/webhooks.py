"""The use cases of webhooks, without HTTP. All calls block."""

from __future__ import annotations

from datetime import UTC, datetime

import structlog

from advtex_contract.errors import ErrorCode, ErrorDetail
from advtex_contract.webhooks import WebhookList, WebhookSpec, WebhookView
from advtex_server.refusal import ApiError
from advtex_server.targets import TargetRefused, TargetRules
from advtex_store.models import WebhookRow
from advtex_store.webhooks import Webhooks

log = structlog.get_logger("advtex.server")


class WebhookService:
    """What a caller can do with webhooks."""

    def __init__(self, webhooks: Webhooks, rules: TargetRules) -> None:
        self._webhooks = webhooks
        self._rules = rules

    def create(self, owner: str, spec: WebhookSpec) -> WebhookView:
        """With its secret. ApiError if nothing may be sent there."""
        try:
            self._rules.resolve(spec.url)
        except TargetRefused as refusal:
            raise _refused("url", str(refusal), "give an https:// address that can be reached from anywhere") from None
        row = self._webhooks.create(owner, spec.url, spec.events)
        log.info("webhook created", webhook=row.id)
        return _view(row, with_secret=True)

    def webhooks(self, owner: str) -> WebhookList:
        return WebhookList(webhooks=[_view(row) for row in self._webhooks.webhooks(owner)])

    def webhook(self, owner: str, webhook_id: str) -> WebhookView:
        return _view(self._webhooks.webhook(webhook_id, owner))

    def enable(self, owner: str, webhook_id: str) -> WebhookView:
        return _view(self._webhooks.enable(webhook_id, owner))

    def delete(self, owner: str, webhook_id: str) -> None:
        self._webhooks.delete(webhook_id, owner)


def _refused(where: str, message: str, remedy: str) -> ApiError:
    detail = ErrorDetail(code="bad_webhook", where=where, message=message, remedy=remedy)
    return ApiError(ErrorCode.bad_request, f"{where}: {message}", [detail], status=422)


def _view(row: WebhookRow, *, with_secret: bool = False) -> WebhookView:
    return WebhookView(
        id=row.id,
        url=row.url,
        events=row.events,
        secret=row.secret if with_secret else None,
        failures=row.failures,
        last_error=row.last_error,
        created_at=datetime.fromtimestamp(row.created_at, UTC),
        disabled_at=datetime.fromtimestamp(row.disabled_at, UTC) if row.disabled_at else None,
    )
