"""The page's own files: read once, sent compressed where that helps, and kept by browsers for good.

Their address holds a digest of all of them, so that a browser never mixes those of two versions.
"""

from __future__ import annotations

import functools
import gzip
import hashlib
import mimetypes
from dataclasses import dataclass
from pathlib import Path

from starlette.requests import Request
from starlette.responses import Response

import advtex_viewer

FOLDER = Path(__file__).parent / "static"
SUFFIXES = frozenset({".css", ".js", ".svg"})
FOREVER = "public, max-age=31536000, immutable"


@dataclass(frozen=True, slots=True)
class StaticFile:
    """One file as it is sent."""

    body: bytes
    gzipped: bytes
    etag: str
    media_type: str


@functools.cache
def static_files() -> dict[str, Path]:
    """All that may be asked for, by name: the page's own files, and those of the viewer as if they lay beside them."""
    return {
        path.relative_to(folder).as_posix(): path
        for folder in (FOLDER, advtex_viewer.FOLDER)
        for path in sorted(folder.rglob("*"))
        if path.suffix in SUFFIXES
    }


@functools.cache
def version() -> str:
    """Of all files together."""
    digest = hashlib.sha256()
    for name, path in static_files().items():
        digest.update(f"{name}\0{hashlib.sha256(path.read_bytes()).hexdigest()}\n".encode())
    return digest.hexdigest()[:12]


@functools.cache
def static_file(name: str) -> StaticFile | None:
    """None if there is none of this name."""
    path = static_files().get(name)
    if path is None:
        return None
    body = path.read_bytes()
    media_type = "text/javascript" if path.suffix == ".js" else mimetypes.guess_type(name)[0] or "text/plain"
    return StaticFile(body, gzip.compress(body, 6, mtime=0), hashlib.sha256(body).hexdigest()[:32], media_type)


def static_answer(request: Request, asked_version: str, name: str) -> Response | None:
    """A file, or that it has not changed. A page of another version than this server's gets the file too, but not to
    keep."""
    file = static_file(name)
    if file is None:
        return None
    packed = "gzip" in request.headers.get("accept-encoding", "")
    etag = f'"{file.etag}{"-gzip" if packed else ""}"'
    headers = {
        "Cache-Control": FOREVER if asked_version == version() else "no-cache",
        "ETag": etag,
        "Vary": "Accept-Encoding",
    }
    if etag in [tag.strip().removeprefix("W/") for tag in request.headers.get("if-none-match", "").split(",")]:
        return Response(status_code=304, headers=headers)
    if packed:
        headers["Content-Encoding"] = "gzip"
    return Response(file.gzipped if packed else file.body, headers=headers, media_type=file.media_type)
