"""Webhooks and their outbox. What is to be told is written with the change itself; a server delivers it later."""

from __future__ import annotations

import base64
import json
import secrets
from collections.abc import Collection
from dataclasses import dataclass
from datetime import UTC, datetime

from sqlalchemy import delete, func, select, update
from sqlalchemy.orm import Session

from advtex_contract.jobs import JobState
from advtex_contract.webhooks import JobEvent, JobEventData, JobEventError
from advtex_store.accounts import lock_owner
from advtex_store.database import Database
from advtex_store.errors import QuotaExceeded, RecordNotFound
from advtex_store.ids import new_id
from advtex_store.models import DeliveryRow, JobRow, WebhookRow

MOST_PER_OWNER = 10
TRY_SECONDS = 60.0  # a try that its server has not reported on by then has failed
PAUSES = (5.0, 30.0, 300.0, 1800.0, 7200.0, 18_000.0, 36_000.0)  # after so many tries in a row that failed
MOST_FAILURES = len(PAUSES) + 1  # in a row: the webhook is disabled
KEPT_SECONDS = 7 * 86400.0  # what could not be delivered by then is dropped


@dataclass(frozen=True, slots=True)
class Delivery:
    """One try that is due."""

    id: str
    webhook_id: str
    url: str
    secret: str
    body: str


class Webhooks:
    """Webhooks in the database."""

    def __init__(self, database: Database) -> None:
        self.database = database

    def create(self, owner: str, url: str, events: Collection[JobState]) -> WebhookRow:
        """A webhook with a secret of its own. QuotaExceeded: the owner has as many as one may have."""
        with self.database.write() as session:
            lock_owner(session, owner)
            count = session.scalar(select(func.count()).where(WebhookRow.owner == owner)) or 0
            if count >= MOST_PER_OWNER:
                raise QuotaExceeded(f"there are {count} webhooks already: delete one")
            now = self.database.now(session)
            row = WebhookRow(
                id=new_id(now),
                owner=owner,
                url=url,
                secret="whsec_" + base64.b64encode(secrets.token_bytes(32)).decode(),
                events=sorted(events),
                failures=0,
                last_error="",
                created_at=now,
            )
            session.add(row)
            return row

    def webhooks(self, owner: str) -> list[WebhookRow]:
        """All of an owner, oldest first."""
        with self.database.read() as session:
            return list(session.scalars(select(WebhookRow).where(WebhookRow.owner == owner).order_by(WebhookRow.id)))

    def webhook(self, webhook_id: str, owner: str) -> WebhookRow:
        """One; RecordNotFound also when it belongs to another owner."""
        with self.database.read() as session:
            return _get(session, webhook_id, owner)

    def enable(self, webhook_id: str, owner: str) -> WebhookRow:
        """Start again, with what has been waiting."""
        with self.database.write() as session:
            row = _get(session, webhook_id, owner)
            row.disabled_at, row.failures, row.last_error = None, 0, ""
            _resume(session, webhook_id, self.database.now(session))
            return row

    def delete(self, webhook_id: str, owner: str) -> None:
        """Forget it, with what has not been delivered."""
        with self.database.write() as session:
            session.delete(_get(session, webhook_id, owner))

    # -- deliverer ------------------------------------------------------------------------------------------------

    def take_due(self, limit: int, busy: Collection[str] = ()) -> list[Delivery]:
        """Deliveries to try now, one per webhook, none of those in `busy`. Other servers do not get them meanwhile."""
        with self.database.read() as session:
            now = self.database.now(session)
            due = (DeliveryRow.next_try_at <= now, WebhookRow.disabled_at.is_(None), WebhookRow.id.not_in(busy))
            place = func.row_number().over(
                partition_by=DeliveryRow.webhook_id, order_by=(DeliveryRow.tries, DeliveryRow.id)
            )
            ranked = select(DeliveryRow.id, place.label("place")).join(WebhookRow).where(*due).subquery()
            chosen = session.scalars(select(ranked.c.id).where(ranked.c.place == 1).limit(limit)).all()
        if not chosen:
            return []
        with self.database.write() as session:
            taken = session.scalars(
                update(DeliveryRow)
                .where(DeliveryRow.id.in_(chosen), DeliveryRow.next_try_at <= now)
                .values(tries=DeliveryRow.tries + 1, next_try_at=now + TRY_SECONDS)
                .returning(DeliveryRow)
            ).all()
            hooks = {
                row.id: row
                for row in session.scalars(
                    select(WebhookRow).where(WebhookRow.id.in_({delivery.webhook_id for delivery in taken}))
                )
            }
            return [
                Delivery(row.id, row.webhook_id, hooks[row.webhook_id].url, hooks[row.webhook_id].secret, row.body)
                for row in taken
            ]

    def delivered(self, delivery: Delivery) -> None:
        """The receiver has it."""
        with self.database.write() as session:
            # The webhook is locked before its deliveries, as everywhere: two servers may try two of them at once.
            hook = session.get(WebhookRow, delivery.webhook_id, with_for_update=True)
            session.execute(delete(DeliveryRow).where(DeliveryRow.id == delivery.id))
            if hook is not None and hook.failures:
                hook.failures, hook.last_error = 0, ""
                _resume(session, hook.id, self.database.now(session))

    def failed(self, delivery: Delivery, error: str, *, gone: bool = False) -> bool:
        """The try failed: the webhook pauses, longer every time. `gone`: the receiver wants no more. -> whether the
        webhook is disabled now."""
        with self.database.write() as session:
            hook = session.get(WebhookRow, delivery.webhook_id, with_for_update=True)
            if hook is None:
                return False
            now = self.database.now(session)
            hook.failures, hook.last_error = hook.failures + 1, error[:1000]
            if gone or hook.failures >= MOST_FAILURES:
                hook.disabled_at = now
            resumes = now + PAUSES[min(hook.failures, len(PAUSES)) - 1]
            session.execute(
                update(DeliveryRow)
                .where(DeliveryRow.webhook_id == hook.id)
                .where((DeliveryRow.id == delivery.id) | (DeliveryRow.next_try_at < resumes))
                .values(next_try_at=resumes)
            )
            return hook.disabled_at is not None

    def traceparent(self, delivery: Delivery) -> str | None:
        """Of the job that it tells of."""
        job_id = json.loads(delivery.body)["data"]["id"]
        with self.database.read() as session:
            return session.scalar(select(JobRow.traceparent).where(JobRow.id == job_id))

    def drop_old(self) -> int:
        """Forget what could not be delivered for long. -> how many there were."""
        with self.database.read() as session:
            limit = self.database.now(session) - KEPT_SECONDS
            if session.scalar(select(DeliveryRow.id).where(DeliveryRow.created_at < limit).limit(1)) is None:
                return 0
        with self.database.write() as session:
            dropped = delete(DeliveryRow).where(DeliveryRow.created_at < limit).returning(DeliveryRow.id)
            return len(session.scalars(dropped).all())


def tell_webhooks(session: Session, row: JobRow, at: float) -> None:
    """Put the job's new state into the outbox of everyone who wants to know; inside the transaction that changes it."""
    hooks = select(WebhookRow).where(WebhookRow.owner == row.owner)
    # None of them can be deleted now, which would undo the change that is to be told.
    for hook in session.scalars(hooks.with_for_update(read=True, key_share=True)):
        if row.state not in hook.events:
            continue
        resumes = None
        if hook.failures:
            latest = select(func.max(DeliveryRow.next_try_at)).where(DeliveryRow.webhook_id == hook.id)
            resumes = session.scalar(latest)
        session.add(
            DeliveryRow(
                id=new_id(at),
                webhook_id=hook.id,
                body=_body(row, at),
                tries=0,
                next_try_at=resumes or at,
                created_at=at,
            )
        )


def _body(row: JobRow, at: float) -> str:
    error = JobEventError(code=row.error["code"], message=row.error["message"]) if row.error else None
    data = JobEventData(id=row.id, state=JobState(row.state), attempt=row.attempt, label=row.label, error=error)
    return JobEvent(type=f"job.{row.state}", timestamp=datetime.fromtimestamp(at, UTC), data=data).model_dump_json()


def _get(session: Session, webhook_id: str, owner: str) -> WebhookRow:
    row = session.scalar(select(WebhookRow).where(WebhookRow.id == webhook_id, WebhookRow.owner == owner))
    if row is None:
        raise RecordNotFound(f"there is no webhook {webhook_id}")
    return row


def _resume(session: Session, webhook_id: str, now: float) -> None:
    session.execute(
        update(DeliveryRow)
        .where(DeliveryRow.webhook_id == webhook_id, DeliveryRow.next_try_at > now)
        .values(next_try_at=now)
    )
