"""tus 1.0.0 (https://tus.io/protocols/resumable-upload): its headers, and the middleware for what every answer has.

Extensions: creation, creation-with-upload, checksum, termination, expiration.
"""

from __future__ import annotations

import base64
import binascii
import re
from datetime import datetime
from email.utils import format_datetime
from urllib.parse import unquote

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from advtex_contract.errors import ErrorCode
from advtex_server.errors import respond
from advtex_server.intake import Checksum
from advtex_server.refusal import ApiError

VERSION = "1.0.0"
EXTENSIONS = "creation,creation-with-upload,checksum,termination,expiration"
ALGORITHMS = {"sha1": 20, "sha256": 32, "sha512": 64, "md5": 16}  # digest sizes
OFFSET_STREAM = "application/offset+octet-stream"
MAX_METADATA = 4096
UPLOADS = "/v1/uploads"
_KEY = re.compile(r"[^\s,]+")


class TusMiddleware:
    """The version in every answer to a tus client, the check of theirs, and methods that proxies do not pass."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or not scope["path"].startswith(UPLOADS):
            await self.app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        version = headers.get("tus-resumable")
        if version is None:
            await self.app(scope, receive, send)
            return

        async def versioned(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message)["Tus-Resumable"] = VERSION
            await send(message)

        if version != VERSION:
            await respond(scope, unsupported_version(version))(scope, receive, versioned)
            return
        if scope["method"] == "POST" and "x-http-method-override" in headers:
            scope["method"] = headers["x-http-method-override"].upper()
        await self.app(scope, receive, versioned)


def unsupported_version(version: str | None) -> ApiError:
    """412, with the version that is spoken here."""
    said = "no Tus-Resumable header came" if version is None else f"tus {version} is not spoken here"
    return ApiError(
        ErrorCode.precondition_failed, f"{said}: send 'Tus-Resumable: {VERSION}'", headers={"Tus-Version": VERSION}
    )


def whole_number(name: str, value: str | None) -> int:
    """A header that must be a count of bytes."""
    if value is None or not re.fullmatch(r"[0-9]{1,18}", value):
        raise ApiError(ErrorCode.bad_request, f"{name} must be a whole number of bytes, not {value!r}")
    return int(value)


def parse_metadata(header: str) -> dict[str, str]:
    """`Upload-Metadata`: pairs of a name and a value in base64, separated by commas."""
    if len(header) > MAX_METADATA:
        raise ApiError(ErrorCode.bad_request, f"Upload-Metadata is longer than {MAX_METADATA} characters")
    found = {}
    for pair in header.split(",") if header.strip() else []:
        name, _, value = pair.strip().partition(" ")
        try:
            text = base64.b64decode(value, validate=True).decode()
        except (binascii.Error, UnicodeDecodeError):
            text = None
        if not _KEY.fullmatch(name) or name in found or text is None:
            raise ApiError(ErrorCode.bad_request, f"Upload-Metadata: {pair.strip()!r} is no name and base64 of UTF-8")
        found[name] = text
    return found


def parse_checksum(header: str | None) -> Checksum | None:
    """`Upload-Checksum`: an algorithm and a digest in base64."""
    if header is None:
        return None
    algorithm, _, value = header.strip().partition(" ")
    try:
        digest = base64.b64decode(value, validate=True)
    except binascii.Error:
        digest = b""
    if len(digest) != ALGORITHMS.get(algorithm):
        raise ApiError(
            ErrorCode.bad_request, f"Upload-Checksum {header!r} is no base64 digest by one of {', '.join(ALGORITHMS)}"
        )
    return Checksum(algorithm, digest)


def announced_sha256(content_digest: str | None, x_content_sha256: str | None) -> str | None:
    """The SHA-256 (hexadecimal) that a request announces: RFC 9530 `Content-Digest: sha-256=:…:`, or plain hex."""
    if x_content_sha256 is not None:
        value = x_content_sha256.strip().lower()
        if len(value) != 64 or set(value) - set("0123456789abcdef"):
            raise ApiError(ErrorCode.bad_request, "X-Content-SHA256 must be 64 hexadecimal digits")
        return value
    for member in (content_digest or "").split(","):
        name, _, value = member.strip().partition("=")
        if name == "sha-256":
            try:
                digest = base64.b64decode(value.strip(":"), validate=True)
            except binascii.Error:
                digest = b""
            if len(digest) != 32 or not (value.startswith(":") and value.endswith(":")):
                raise ApiError(ErrorCode.bad_request, "Content-Digest must be sha-256=:base64 of 32 bytes:")
            return digest.hex()
    return None


def shown_name(name: str) -> str:
    """A file's name as people may see it."""
    return "".join(c for c in name if c.isprintable())


def decoded_name(header: str) -> str:
    """The same from a percent-encoded header."""
    return shown_name(unquote(header))


def http_date(moment: datetime) -> str:
    """For `Upload-Expires`."""
    return format_datetime(moment, usegmt=True)
