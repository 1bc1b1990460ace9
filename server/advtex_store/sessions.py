"""Browsers that are signed in: opaque tokens, of which only the SHA-256 is stored."""

from __future__ import annotations

import hashlib
import secrets

from sqlalchemy import delete, select

from advtex_store.accounts import Caller, caller_of
from advtex_store.database import Database
from advtex_store.models import ApiKeyRow, SessionRow

LINK_SECONDS = 86400.0


class Sessions:
    """A session ends at its time, by signing out, and with its key, whichever comes first."""

    def __init__(self, database: Database) -> None:
        self.database = database

    def begin(self, key_id: str, seconds: float) -> str:
        """A token for a browser that has shown this key."""
        return self._add(key_id, seconds, link=False)

    def offer(self, key_id: str) -> str:
        """A token for a link that signs one browser in, once, within a day."""
        return self._add(key_id, LINK_SECONDS, link=True)

    def follow(self, token: str, seconds: float) -> str | None:
        """The session for a link's token, None if that is unknown, used or too old."""
        with self.database.write() as session:
            used = delete(SessionRow).where(SessionRow.token_sha256 == _digest(token), SessionRow.link.is_(True))
            row = session.execute(used.returning(SessionRow.key_id, SessionRow.expires_at)).one_or_none()
            now = self.database.now(session)
            if row is None or row.expires_at <= now or caller_of(session.get(ApiKeyRow, row.key_id), now) is None:
                return None
        return self.begin(row.key_id, seconds)

    def caller(self, token: str) -> Caller | None:
        """Whose browser it is, None if the session has ended or its key is no longer good."""
        query = (
            select(SessionRow.expires_at, ApiKeyRow)
            .join(ApiKeyRow, ApiKeyRow.id == SessionRow.key_id)
            .where(SessionRow.token_sha256 == _digest(token), SessionRow.link.is_(False))
        )
        with self.database.read() as session:
            row = session.execute(query).one_or_none()
            now = self.database.now(session)
            return None if row is None or row[0] <= now else caller_of(row[1], now)

    def end(self, token: str) -> None:
        """Sign out."""
        with self.database.write() as session:
            session.execute(delete(SessionRow).where(SessionRow.token_sha256 == _digest(token)))

    def _add(self, key_id: str, seconds: float, *, link: bool) -> str:
        token = secrets.token_urlsafe(32)
        with self.database.write() as session:
            now = self.database.now(session)
            session.execute(delete(SessionRow).where(SessionRow.expires_at <= now))
            session.add(SessionRow(token_sha256=_digest(token), key_id=key_id, link=link, expires_at=now + seconds))
        return token


def _digest(token: str) -> str:
    return hashlib.sha256(token.encode()).hexdigest()
