"""API keys: `adv_<id>_<secret>`. Only the secret's SHA-256 is stored."""

from __future__ import annotations

import hashlib
import hmac
import re
import secrets
from collections.abc import Sequence
from dataclasses import dataclass

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from advtex_contract.jobs import TERMINAL
from advtex_store.database import Database
from advtex_store.errors import QuotaExceeded, RecordNotFound
from advtex_store.models import ApiKeyRow, JobRow, UploadRow

SCOPES = ("read", "write", "admin")  # admin: sees how the whole fleet is, and whose jobs wait
LONGEST_NAME = 255  # PostgreSQL insists on the width of a column, SQLite does not
_KEY = re.compile(r"adv_([0-9a-f]{12})_([A-Za-z0-9]{40})")
_ALPHABET = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789"


@dataclass(frozen=True, slots=True)
class Caller:
    """Who sent a request. Objects belong to `owner`; several keys may share one."""

    key_id: str
    owner: str
    scopes: frozenset[str]
    max_active_jobs: int | None = None
    max_bytes: int | None = None
    expires_at: float | None = None
    max_running_jobs: int | None = None


@dataclass(frozen=True, slots=True)
class Usage:
    """What an owner has: jobs that have not ended, and bytes of uploads that are kept or on their way."""

    active_jobs: int
    bytes: int


class Accounts:
    """API keys in the database."""

    def __init__(self, database: Database) -> None:
        self.database = database

    def create_key(
        self,
        name: str = "",
        *,
        owner: str | None = None,
        scopes: Sequence[str] = ("read", "write"),
        expires_at: float | None = None,
        max_active_jobs: int | None = None,
        max_bytes: int | None = None,
        max_running_jobs: int | None = None,
    ) -> str:
        """Make a key; the only time that its secret can be seen. Without an owner, it is an owner of its own."""
        if unknown := set(scopes) - set(SCOPES):
            raise ValueError(f"unknown scope {sorted(unknown)}: the scopes are {', '.join(SCOPES)}")
        if max(len(name), len(owner or "")) > LONGEST_NAME:
            raise ValueError(f"the names of a key and of its owner have {LONGEST_NAME} characters at most")
        key_id = secrets.token_hex(6)
        secret = "".join(secrets.choice(_ALPHABET) for _ in range(40))
        with self.database.write() as session:
            session.add(
                ApiKeyRow(
                    id=key_id,
                    owner=owner or key_id,
                    name=name,
                    secret_sha256=hashlib.sha256(secret.encode()).hexdigest(),
                    scopes=sorted(scopes),
                    max_active_jobs=max_active_jobs,
                    max_bytes=max_bytes,
                    max_running_jobs=max_running_jobs,
                    created_at=self.database.now(session),
                    expires_at=expires_at,
                )
            )
        return f"adv_{key_id}_{secret}"

    def authenticate(self, key: str) -> Caller | None:
        """The caller behind a key, None if it is malformed, unknown, revoked or expired."""
        match = _KEY.fullmatch(key)
        if match is None:
            return None
        key_id, secret = match.groups()
        digest = hashlib.sha256(secret.encode()).hexdigest()
        with self.database.read() as session:
            row = session.get(ApiKeyRow, key_id)
            stored = row.secret_sha256 if row is not None else "0" * 64
            matches = hmac.compare_digest(stored, digest)
            return caller_of(row, self.database.now(session)) if matches else None

    def rotate_key(self, key_id: str, keep_seconds: float = 0.0) -> str:
        """A new key with everything that the old one had; the old one works for `keep_seconds` more."""
        with self.database.read() as session:
            row = session.get(ApiKeyRow, key_id)
            if row is None or row.revoked_at is not None:
                raise RecordNotFound(f"there is no key {key_id}, or it was revoked")
        key = self.create_key(
            row.name,
            owner=row.owner,
            scopes=row.scopes,
            expires_at=row.expires_at,
            max_active_jobs=row.max_active_jobs,
            max_bytes=row.max_bytes,
            max_running_jobs=row.max_running_jobs,
        )
        with self.database.write() as session:
            old = session.get_one(ApiKeyRow, key_id)
            end = self.database.now(session) + keep_seconds
            old.expires_at = end if old.expires_at is None else min(old.expires_at, end)
        return key

    def set_quota(
        self, key_id: str, max_active_jobs: int | None, max_bytes: int | None, max_running_jobs: int | None = None
    ) -> None:
        """Replace all three limits; None for none."""
        with self.database.write() as session:
            row = session.get(ApiKeyRow, key_id)
            if row is None:
                raise RecordNotFound(f"there is no key {key_id}")
            row.max_active_jobs, row.max_bytes = max_active_jobs, max_bytes
            row.max_running_jobs = max_running_jobs

    def usage(self, owner: str) -> Usage:
        """What counts towards the quotas."""
        stored = select(func.coalesce(func.sum(UploadRow.size), 0)).where(
            UploadRow.owner == owner, UploadRow.deleted_at.is_(None)
        )
        with self.database.read() as session:
            return Usage(_active_jobs(session, owner), int(session.scalar(stored) or 0))

    def list_keys(self) -> list[ApiKeyRow]:
        """All keys, oldest first."""
        with self.database.read() as session:
            return list(session.scalars(select(ApiKeyRow).order_by(ApiKeyRow.created_at)))

    def revoke_key(self, key_id: str) -> None:
        """From now on the key is refused."""
        with self.database.write() as session:
            row = session.get(ApiKeyRow, key_id)
            if row is None:
                raise RecordNotFound(f"there is no key {key_id}")
            row.revoked_at = row.revoked_at or self.database.now(session)


def key_id(key: str) -> str:
    """The part of a key that is no secret."""
    return key.split("_")[1]


def caller_of(row: ApiKeyRow | None, now: float) -> Caller | None:
    """None for a key that is unknown, revoked or expired."""
    if row is None or row.revoked_at is not None or (row.expires_at is not None and row.expires_at <= now):
        return None
    scopes = frozenset(row.scopes)
    limits = row.max_active_jobs, row.max_bytes, row.expires_at, row.max_running_jobs
    return Caller(row.id, row.owner, scopes, *limits)


def lock_owner(session: Session, owner: str) -> None:
    """Until the transaction ends nobody else passes here for this owner: two requests at once cannot both take the
    last place of a quota."""
    query = select(ApiKeyRow.id).where(ApiKeyRow.owner == owner).order_by(ApiKeyRow.id)
    session.scalars(query.with_for_update()).all()


def check_active_jobs(session: Session, owner: str, most: int | None) -> None:
    """QuotaExceeded if one more job would be too many; inside the transaction that adds it."""
    if most is None:
        return
    lock_owner(session, owner)
    active = _active_jobs(session, owner)
    if active >= most:
        raise QuotaExceeded(f"{active} jobs have not ended yet and this key may have {most}: wait, or cancel some")


def _active_jobs(session: Session, owner: str) -> int:
    query = select(func.count()).where(
        JobRow.owner == owner, JobRow.state.not_in(TERMINAL), JobRow.deleted_at.is_(None)
    )
    return session.scalar(query) or 0
