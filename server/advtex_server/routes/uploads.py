"""Uploads: resumable ones as tus 1.0.0 has them, or the body of one plain POST for small scans and curl."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends, Header, Path, Query, Request, Response
from starlette.concurrency import run_in_threadpool

from advtex_contract.errors import ErrorCode
from advtex_contract.jobs import ID_PATTERN, StorageInfo, UploadList, UploadView
from advtex_server import tus
from advtex_server.bodies import OpenBodies, receive
from advtex_server.deps import Reader, TheIntake, TheService, Writer, reader
from advtex_server.intake import Checksum, Intake, upload_view
from advtex_server.refusal import WITH_KEY, ApiError, refuses
from advtex_store.models import UploadRow

router = APIRouter(prefix="/v1", tags=["uploads"], responses=WITH_KEY)

PATIENCE = 30.0  # seconds that a request waits for an older one of the same upload to be kept
HEAD_PATIENCE = 0.3  # a client that asks where to go on has lost its line already

UploadId = Annotated[str, Path(pattern=ID_PATTERN)]
TusVersion = Annotated[str | None, Header(description="1.0.0; without it this is a plain upload")]
TusChecksum = Annotated[str | None, Header(description="tus: algorithm and base64 digest of this body")]
OTHER_TUS = refuses(ErrorCode.precondition_failed)
OF_AN_UPLOAD = OTHER_TUS | refuses(ErrorCode.not_found, 422)
RECEIVING = OF_AN_UPLOAD | refuses(
    ErrorCode.bad_request,
    ErrorCode.conflict,
    ErrorCode.too_large,
    ErrorCode.checksum_mismatch,
    ErrorCode.insufficient_storage,
    408,
    422,
    460,
)
BINARY = {"schema": {"type": "string", "format": "binary"}}


def _headers(**described: str) -> dict[str, dict[str, object]]:
    return {
        name.replace("_", "-"): {"description": text, "schema": {"type": "string"}} for name, text in described.items()
    }


TEXTURE = {"operationId": "create_job_v1_jobs_post", "requestBody": {"upload_id": "$response.body#/id"}}
OFFSET = _headers(Upload_Offset="bytes that are durable", Upload_Expires="when an unfinished upload is forgotten")


@router.options(
    "/uploads", status_code=204, dependencies=[Depends(reader)], response_class=Response, responses=OTHER_TUS
)
async def upload_features(service: TheService) -> Response:
    """What the server speaks (tus)."""
    headers = {
        "Tus-Version": tus.VERSION,
        "Tus-Extension": tus.EXTENSIONS,
        "Tus-Checksum-Algorithm": ",".join(tus.ALGORITHMS),
        "Tus-Max-Size": str(service.settings.max_upload_bytes),
        "Tus-Resumable": tus.VERSION,
    }
    return Response(status_code=204, headers=headers)


@router.post(
    "/uploads",
    status_code=201,
    openapi_extra={
        "requestBody": {"required": False, "content": {"application/zip": BINARY, tus.OFFSET_STREAM: BINARY}}
    },
    responses={201: {"headers": _headers(Location="the upload") | OFFSET, "links": {"texture": TEXTURE}}}
    | RECEIVING
    | refuses(ErrorCode.too_large, ErrorCode.quota_exceeded, 411),
)
async def create_upload(
    request: Request,
    response: Response,
    caller: Writer,
    intake: TheIntake,
    tus_resumable: TusVersion = None,
    upload_length: Annotated[str | None, Header(description="tus: bytes of the scan")] = None,
    upload_metadata: Annotated[str, Header(description="tus: `filename` and `sha256` (hexadecimal) are used")] = "",
    upload_checksum: TusChecksum = None,
    content_digest: Annotated[str | None, Header(description="RFC 9530, `sha-256=:base64:`")] = None,
    x_content_sha256: Annotated[str | None, Header(description="SHA-256 of the body, hexadecimal")] = None,
    x_filename: Annotated[str, Header(max_length=1000, description="percent-encoded")] = "",
) -> UploadView:
    """Send a scan as a zip. With `Tus-Resumable` this begins a resumable upload, which may be sent with it in part;
    without, the body is the scan, and the answer comes when its bytes are durable."""
    if tus_resumable is not None:
        given = tus.parse_metadata(upload_metadata)
        size = tus.whole_number("Upload-Length", upload_length)
        sha256 = tus.announced_sha256(content_digest, given.get("sha256", x_content_sha256))
        checksum = tus.parse_checksum(upload_checksum)
        filename = tus.shown_name(given.get("filename", given.get("name", "")))
        row = await run_in_threadpool(intake.create, caller, size, filename, sha256, upload_metadata)
        view = await run_in_threadpool(intake.view, caller.owner, row.id)
        if request.headers.get("content-type") == tus.OFFSET_STREAM:
            view = await _receive(request, intake, row, checksum=checksum)
    else:
        length = request.headers.get("content-length", "")
        if not (length.isascii() and length.isdigit()):
            raise ApiError(ErrorCode.bad_request, "an upload needs a Content-Length", status=411)
        sha256 = tus.announced_sha256(content_digest, x_content_sha256)
        row = await run_in_threadpool(intake.create, caller, int(length), tus.decoded_name(x_filename), sha256)
        view = await _receive_whole(request, intake, row)
    response.headers["Location"] = f"/v1/uploads/{view.id}"
    response.headers.update(_progress(view))
    return view


@router.get("/uploads", responses=OTHER_TUS | refuses(422))
def find_uploads(
    caller: Reader,
    intake: TheIntake,
    sha256: Annotated[str, Query(pattern="^[0-9a-f]{64}$", description="of the whole scan, hexadecimal")],
) -> UploadList:
    """Your uploads of these bytes, whole ones first: what is held already need not be sent again."""
    return UploadList(uploads=intake.find(caller.owner, sha256))


@router.get("/uploads/{upload_id}", responses=OF_AN_UPLOAD)
def get_upload(upload_id: UploadId, caller: Reader, intake: TheIntake) -> UploadView:
    """An upload; complete once `sha256` is set."""
    return intake.view(caller.owner, upload_id)


@router.head(
    "/uploads/{upload_id}",
    response_class=Response,
    responses={200: {"headers": OFFSET, "description": "its offset"}} | OF_AN_UPLOAD | refuses(ErrorCode.conflict),
)
async def head_upload(
    upload_id: UploadId, caller: Writer, intake: TheIntake, request: Request, tus_resumable: TusVersion = None
) -> Response:
    """Where to go on (tus). Ends the request that is still sending bytes for this upload, if there is one."""
    if tus_resumable is None:
        raise tus.unsupported_version(None)
    await run_in_threadpool(intake.view, caller.owner, upload_id)
    await _bodies(request).end(upload_id, HEAD_PATIENCE)
    row = await run_in_threadpool(intake.offset, caller.owner, upload_id)
    view = await run_in_threadpool(intake.view, caller.owner, upload_id)
    headers = {"Upload-Length": str(row.size), "Cache-Control": "no-store", **_progress(view)}
    if row.tus_metadata:
        headers["Upload-Metadata"] = row.tus_metadata
    return Response(headers=headers)


@router.patch(
    "/uploads/{upload_id}",
    status_code=204,
    response_class=Response,
    openapi_extra={"requestBody": {"required": True, "content": {tus.OFFSET_STREAM: BINARY}}},
    responses={204: {"headers": OFFSET, "description": "the bytes are durable"}} | RECEIVING | refuses(415),
)
async def patch_upload(
    upload_id: UploadId,
    caller: Writer,
    intake: TheIntake,
    request: Request,
    tus_resumable: TusVersion = None,
    upload_offset: Annotated[str | None, Header(description="where the body begins; must be the upload's")] = None,
    upload_checksum: TusChecksum = None,
) -> Response:
    """Send the bytes that follow (tus). The newest request wins: an older one that is still open ends."""
    if tus_resumable is None:
        raise tus.unsupported_version(None)
    if request.headers.get("content-type") != tus.OFFSET_STREAM:
        raise ApiError(ErrorCode.bad_request, f"the Content-Type must be {tus.OFFSET_STREAM}", status=415)
    offset = tus.whole_number("Upload-Offset", upload_offset)
    checksum = tus.parse_checksum(upload_checksum)
    row = await run_in_threadpool(intake.upload, caller.owner, upload_id)
    view = await _receive(request, intake, row, offset, checksum)
    return Response(status_code=204, headers=_progress(view))


@router.delete("/uploads/{upload_id}", status_code=204, responses=OF_AN_UPLOAD | refuses(ErrorCode.conflict))
async def delete_upload(upload_id: UploadId, caller: Writer, intake: TheIntake, request: Request) -> Response:
    """Remove an upload that no job needs."""
    await run_in_threadpool(intake.view, caller.owner, upload_id)
    await _bodies(request).end(upload_id, PATIENCE)
    await run_in_threadpool(intake.delete, caller.owner, upload_id)
    return Response(status_code=204)


@router.get("/storage", dependencies=[Depends(reader)])
def get_storage(service: TheService) -> StorageInfo:
    """What the server accepts at most, and how long it keeps things."""
    return service.storage()


async def _receive(
    request: Request, intake: Intake, row: UploadRow, offset: int = 0, checksum: Checksum | None = None
) -> UploadView:
    """The body of a request that goes on with an upload at `offset`. `row` gets the holder: this request."""
    length = request.headers.get("content-length", "0")
    async with _bodies(request).alone(row.id, PATIENCE) as body:
        now = await run_in_threadpool(intake.store.uploads.upload, row.id, row.owner)
        if now.sha256 is not None:
            _check_place(now, offset, length)
            return upload_view(now)
        receiving = await run_in_threadpool(intake.resume, row.owner, row.id, checksum)
        row.holder = receiving.row.holder
        try:
            _check_place(receiving.row, offset, length)
            await receive(body, request.stream(), receiving, intake.settings.idle_seconds)
            return await run_in_threadpool(receiving.end)
        finally:
            receiving.close()


def _check_place(row: UploadRow, offset: int, length: str) -> None:
    if offset != row.offset:
        raise ApiError(ErrorCode.conflict, f"upload {row.id} is at offset {row.offset}, not at {offset}")
    if length.isdigit() and int(length) > row.size - offset:
        raise ApiError(ErrorCode.too_large, f"{length} bytes come, {row.size - offset} are missing")


async def _receive_whole(request: Request, intake: Intake, row: UploadRow) -> UploadView:
    """The body of a plain upload: all of it, or nothing is kept."""
    try:
        view = await _receive(request, intake, row)
        if not view.complete:
            raise ApiError(ErrorCode.bad_request, f"{view.offset} bytes came, {row.size} were announced")
    except Exception:
        await run_in_threadpool(intake.forget, row.id, row.holder)
        raise
    except BaseException:
        intake.forget(row.id, row.holder)  # inline: a canceled task could not wait for a thread
        raise
    return view


def _bodies(request: Request) -> OpenBodies:
    bodies: OpenBodies = request.app.state.bodies
    return bodies


def _progress(view: UploadView) -> dict[str, str]:
    headers = {"Upload-Offset": str(view.offset)}
    if not view.complete and view.expires_at is not None:
        headers["Upload-Expires"] = tus.http_date(view.expires_at)
    return headers
