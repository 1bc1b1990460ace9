"""How a server is, and what a key may do: what a client asks before it blames itself."""

from __future__ import annotations

from datetime import datetime
from typing import Literal

from pydantic import BaseModel


class Alive(BaseModel):
    """Body of `GET /healthz`."""

    status: Literal["ok"] = "ok"


class PartView(BaseModel):
    """One part of the service. `essential`: without it no work can be accepted. `message`: what is wrong, in words."""

    ok: bool
    essential: bool
    message: str = ""


class Readiness(BaseModel):
    """Body of `GET /readyz`: whether work can be accepted, and how each part is."""

    ready: bool
    checks: dict[str, PartView]


class KeyView(BaseModel):
    """The key that a request was sent with.

    active_jobs, bytes: what its owner has of what is limited. Limits are null where there are none.
    """

    id: str
    scopes: list[str]
    expires_at: datetime | None = None
    active_jobs: int
    max_active_jobs: int | None = None
    bytes: int
    max_bytes: int | None = None
    max_running_jobs: int | None = None
