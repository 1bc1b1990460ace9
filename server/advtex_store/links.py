"""Links to one file of a result that work without a key or a session: for apps on phones, which send neither.

A link names who made it and until when it works, with an HMAC over both, the job and the file. Its secret is the stored
hash of the maker's key: every server knows it, no row is written, and links end with the key, too.
"""

from __future__ import annotations

import hashlib
import hmac
import re

from advtex_store.accounts import caller_of
from advtex_store.database import Database
from advtex_store.models import ApiKeyRow

SECONDS = 600
_TOKEN = re.compile(r"([0-9A-Za-z]{1,64})\.([0-9]{1,12})\.([0-9a-f]{64})")


class Links:
    """Whoever has a link can read its file, and nothing else."""

    def __init__(self, database: Database) -> None:
        self.database = database

    def make(self, key_id: str, job_id: str, name: str) -> str:
        """A token for one file of one job, good for SECONDS."""
        with self.database.read() as session:
            expires = int(self.database.now(session)) + SECONDS
            return f"{key_id}.{expires}.{_mac(session.get_one(ApiKeyRow, key_id), expires, job_id, name)}"

    def owner(self, token: str, job_id: str, name: str) -> str | None:
        """Whose file it is; None for a token that was not made for it, is too old, or whose key is no longer good."""
        match = _TOKEN.fullmatch(token)
        if match is None:
            return None
        key_id, expires, mac = match.groups()
        with self.database.read() as session:
            row, now = session.get(ApiKeyRow, key_id), self.database.now(session)
            if row is None or not hmac.compare_digest(_mac(row, int(expires), job_id, name), mac):
                return None
            caller = caller_of(row, now)
            good = caller is not None and "read" in caller.scopes and now < int(expires)
            return row.owner if good else None


def _mac(row: ApiKeyRow, expires: int, job_id: str, name: str) -> str:
    told = "\n".join(("link", row.id, str(expires), job_id, name))
    return hmac.new(bytes.fromhex(row.secret_sha256), told.encode(), hashlib.sha256).hexdigest()
