"""Uploads: the body of one POST, streamed to the blob storage while it is hashed."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, AsyncIterator
from typing import Annotated
from urllib.parse import unquote

from fastapi import APIRouter, Depends, Header, Request, Response
from starlette.concurrency import run_in_threadpool

from advtex_contract.errors import ErrorCode
from advtex_contract.jobs import StorageInfo, UploadView
from advtex_server.deps import Reader, TheService, Writer, reader
from advtex_server.refusal import ApiError
from advtex_server.service import announced_sha256

router = APIRouter(prefix="/v1", tags=["uploads"])

BUFFER = 1 << 20  # bytes handed to the disk at a time


@router.post(
    "/uploads",
    status_code=201,
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": {"application/zip": {"schema": {"type": "string", "format": "binary"}}},
        }
    },
)
async def create_upload(
    request: Request,
    caller: Writer,
    service: TheService,
    content_digest: Annotated[str | None, Header(description="RFC 9530, `sha-256=:base64:`")] = None,
    x_content_sha256: Annotated[str | None, Header(description="SHA-256 of the body, hexadecimal")] = None,
    x_filename: Annotated[str, Header(max_length=1000, description="percent-encoded")] = "",
) -> UploadView:
    """Send a scan as a zip. The answer comes when its bytes are durable."""
    length = request.headers.get("content-length", "")
    if not (length.isascii() and length.isdigit()):
        raise ApiError(ErrorCode.bad_request, "an upload needs a Content-Length", status=411)
    sha256 = announced_sha256(content_digest, x_content_sha256)
    filename = "".join(c for c in unquote(x_filename) if c.isprintable())
    block = service.incoming(caller.owner, int(length), filename, sha256)
    incoming = await run_in_threadpool(block.__enter__)
    try:
        buffer = bytearray()
        async for chunk in _unless_silent(request.stream(), service.settings.idle_seconds):
            buffer += chunk
            if len(buffer) >= BUFFER:
                await run_in_threadpool(incoming.write, bytes(buffer))
                buffer.clear()
        await run_in_threadpool(incoming.write, bytes(buffer))
        view = await run_in_threadpool(incoming.finish)
    except BaseException as error:
        # Run inline: a canceled task could not wait for a thread, and the clean-up must not be skipped.
        block.__exit__(type(error), error, error.__traceback__)
        raise
    await run_in_threadpool(block.__exit__, None, None, None)
    return view


async def _unless_silent(chunks: AsyncGenerator[bytes, None], seconds: float) -> AsyncIterator[bytes]:
    """A half-open connection would hold its room on the disk for ever."""
    while True:
        try:
            async with asyncio.timeout(seconds):
                chunk = await anext(chunks, None)
        except TimeoutError:
            raise ApiError(ErrorCode.bad_request, f"nothing came for {seconds:g} s", status=408) from None
        if chunk is None:
            return
        yield chunk


@router.get("/uploads/{upload_id}")
def get_upload(upload_id: str, caller: Reader, service: TheService) -> UploadView:
    """An upload; complete once `sha256` is set."""
    return service.upload(caller.owner, upload_id)


@router.delete("/uploads/{upload_id}", status_code=204)
def delete_upload(upload_id: str, caller: Writer, service: TheService) -> Response:
    """Remove an upload that no job needs."""
    service.delete_upload(caller.owner, upload_id)
    return Response(status_code=204)


@router.get("/storage", dependencies=[Depends(reader)])
def get_storage(service: TheService) -> StorageInfo:
    """What the server accepts at most, and how long it keeps things."""
    return service.storage()
