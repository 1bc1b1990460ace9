"""Identifiers: lower-case hexadecimal, sorted by time of creation, with 64 random bits."""

from __future__ import annotations

import re
import secrets

ID = re.compile(r"[0-9a-f]{28}")


def new_id(now: float) -> str:
    """28 characters: 12 of milliseconds since 1970, 16 random. Fit for URLs, file names and RQ job ids."""
    return f"{int(now * 1000):012x}{secrets.token_hex(8)}"


def created_at(found: str) -> float:
    """When an id was made, seconds since 1970."""
    return int(found[:12], 16) / 1000
