"""Webhooks: where you want to be told what becomes of your jobs."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path, Response

from advtex_contract.errors import ErrorCode
from advtex_contract.jobs import ID_PATTERN
from advtex_contract.webhooks import WebhookList, WebhookSpec, WebhookView
from advtex_server.deps import Reader, TheWebhooks, Writer
from advtex_server.refusal import WITH_KEY, refuses

router = APIRouter(prefix="/v1/webhooks", tags=["webhooks"], responses=WITH_KEY)

WebhookId = Annotated[str, Path(pattern=ID_PATTERN)]
OF_A_WEBHOOK = refuses(ErrorCode.not_found, 422)


@router.post("", status_code=201, responses=refuses(ErrorCode.bad_request, 422))
def create_webhook(spec: WebhookSpec, caller: Writer, webhooks: TheWebhooks, response: Response) -> WebhookView:
    """Be told of your jobs' new states, as https://www.standardwebhooks.com has it. Only this answer has the secret.

    What is not taken is sent again, ever later; after 8 tries in a row that failed the webhook is disabled until you
    enable it. What could not be delivered within 7 days is dropped: `GET /v1/jobs` still has it.
    """
    view = webhooks.create(caller.owner, spec)
    response.headers["Location"] = f"/v1/webhooks/{view.id}"
    return view


@router.get("")
def list_webhooks(caller: Reader, webhooks: TheWebhooks) -> WebhookList:
    """Your webhooks, oldest first."""
    return webhooks.webhooks(caller.owner)


@router.get("/{webhook_id}", responses=OF_A_WEBHOOK)
def get_webhook(webhook_id: WebhookId, caller: Reader, webhooks: TheWebhooks) -> WebhookView:
    """One webhook, with what went wrong last."""
    return webhooks.webhook(caller.owner, webhook_id)


@router.post("/{webhook_id}/enable", responses=OF_A_WEBHOOK)
def enable_webhook(webhook_id: WebhookId, caller: Writer, webhooks: TheWebhooks) -> WebhookView:
    """Start again after too many failures, with what has been waiting."""
    return webhooks.enable(caller.owner, webhook_id)


@router.delete("/{webhook_id}", status_code=204, responses=OF_A_WEBHOOK)
def delete_webhook(webhook_id: WebhookId, caller: Writer, webhooks: TheWebhooks) -> Response:
    """Tell no more, also not what has been waiting."""
    webhooks.delete(caller.owner, webhook_id)
    return Response(status_code=204)
