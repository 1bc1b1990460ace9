"""What stands between this computer and a textured scan: configuration, server, key, and the folder of its memory."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC

from advtex_client.client import Client
from advtex_client.errors import ClientError
from advtex_client.submissions import check_writable
from advtex_contract.health import KeyView


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at. `error`: why it failed, where that ends the work; a part of the server that may be
    away for a while is not `ok` without being one."""

    name: str
    ok: bool
    message: str
    error: ClientError | None = None


class ServerNotReady(ClientError):
    """A part of the server that it cannot do without does not work."""

    code = "not_ready"


class FolderNotWritable(ClientError):
    """This computer cannot remember its submissions."""

    code = "folder"


def examine(client: Client) -> Iterator[Finding]:
    """Look at everything, in the order in which it is needed."""
    config = client.config
    key_from = f"key from {config.api_key_from}" if config.api_key else "no key"
    yield Finding("configuration", True, f"{config.url} from {config.url_from}, {key_from}")
    try:
        client.ping()
    except ClientError as error:
        yield Finding("server", False, str(error), error)
    else:
        yield Finding("server", True, "it answers")
        yield from _parts(client)
        yield _key(client)
    yield _folder()


def _parts(client: Client) -> Iterator[Finding]:
    try:
        readiness = client.readiness()
    except ClientError as error:
        yield Finding("readiness", False, str(error), error)
        return
    yield Finding("readiness", readiness.ready, "work is accepted" if readiness.ready else "no work is accepted now")
    for name, part in readiness.checks.items():
        if not part.ok:
            yield Finding(name, False, part.message, ServerNotReady(part.message) if part.essential else None)


def _key(client: Client) -> Finding:
    try:
        return Finding("key", True, _described(client.get_key()))
    except ClientError as error:
        return Finding("key", False, str(error), error)


def _described(key: KeyView) -> str:
    """Describe a key: `0123456789ab may read, write; 2 of 20 active jobs; until 2030-01-01 00:00 UTC`."""
    parts = [f"{key.id} may {', '.join(key.scopes)}"]
    if key.max_active_jobs is not None:
        parts.append(f"{key.active_jobs} of {key.max_active_jobs} active jobs")
    if key.max_bytes is not None:
        parts.append(f"{key.bytes} of {key.max_bytes} bytes")
    if key.expires_at is not None:
        parts.append(f"until {key.expires_at.astimezone(UTC):%Y-%m-%d %H:%M} UTC")
    return "; ".join(parts)


def _folder() -> Finding:
    try:
        return Finding("memory", True, f"{check_writable()} can be written")
    except OSError as error:
        message = f"submissions cannot be remembered: {error}; make the folder writable, or set XDG_STATE_HOME"
        return Finding("memory", False, message, FolderNotWritable(message))
