"""API keys: `adv_<id>_<secret>`. Only the secret's SHA-256 is stored."""

from __future__ import annotations

import hashlib
import hmac
import re
import secrets
from collections.abc import Sequence
from dataclasses import dataclass

from sqlalchemy import select

from advtex_store.database import Database
from advtex_store.errors import RecordNotFound
from advtex_store.models import ApiKeyRow

SCOPES = ("read", "write")
_KEY = re.compile(r"adv_([0-9a-f]{12})_([A-Za-z0-9]{40})")
_ALPHABET = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789"


@dataclass(frozen=True, slots=True)
class Caller:
    """Who sent a request. Objects belong to `owner`; several keys may share one."""

    key_id: str
    owner: str
    scopes: frozenset[str]


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
    ) -> str:
        """Make a key; the only time that its secret can be seen. Without an owner, it is an owner of its own."""
        if unknown := set(scopes) - set(SCOPES):
            raise ValueError(f"unknown scope {sorted(unknown)}: the scopes are {', '.join(SCOPES)}")
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
            if row is None or not matches or row.revoked_at is not None:
                return None
            if row.expires_at is not None and row.expires_at <= self.database.now(session):
                return None
            return Caller(row.id, row.owner, frozenset(row.scopes))

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
