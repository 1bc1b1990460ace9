"""Sending a scan so that it arrives whatever the line does, step by step, without sending anything itself.

`sending` is a generator: it yields each Call to be made, receives its answer (or the ClientError that it ended in), and
returns the finished upload. Both clients drive it.
"""

from __future__ import annotations

from collections.abc import Generator
from typing import Any

from advtex_client import _calls as calls
from advtex_client.errors import ApiError, ClientError, ConflictError, NetworkError, NotFoundError
from advtex_client.uploads import FileStream, OnBytes, PackedScan
from advtex_contract.jobs import UploadView

TIMED_OUT = 408  # the server heard nothing for too long
Step = calls.Call[Any] | calls.Pause


def sending(
    scan: PackedScan, retries: int, on_bytes: OnBytes | None = None, known_id: str | None = None
) -> Generator[Step, Any, UploadView]:
    """Send what the server does not hold yet of these bytes, whoever sent the rest with this key and when.

    known_id: the upload to go on with, if the server still has it. The line may break any number of times; after
    `retries` tries in a row that brought nothing, the error is raised.
    """
    upload = yield from _held(scan, known_id)
    offset = upload.offset
    attempts = calls.Attempts(True, retries)
    while not upload.complete:
        try:
            while offset < scan.size:
                offset = yield calls.send_piece(upload.id, FileStream(scan, offset, on_bytes))
                attempts = calls.Attempts(True, retries)
            upload = yield calls.get_upload(upload.id)
        except NotFoundError as error:  # it expired, or its bytes were lost
            yield calls.Pause(attempts.after_error(NetworkError(str(error))))
            upload = yield from _held(scan, None)
            offset = upload.offset
        except ClientError as error:
            if not _may_pass(error):
                raise
            before, offset = offset, (yield calls.upload_offset(upload.id))
            if offset > before:
                attempts = calls.Attempts(True, retries)
            else:
                passing = error if calls.is_passing(error) else NetworkError(str(error))
                yield calls.Pause(attempts.after_error(passing))
    if upload.sha256 != scan.sha256:
        raise ClientError(
            f"{scan.filename} arrived damaged (sha256 {upload.sha256}, sent {scan.sha256}); submit it again"
        )
    return upload


def _held(scan: PackedScan, known_id: str | None) -> Generator[Step, Any, UploadView]:
    """Return the upload that came farthest, or a new one."""
    try:
        found = (yield calls.find_uploads(scan.sha256)).uploads
        if not found:
            upload: UploadView = yield calls.begin_upload(scan)
            return upload
    except NetworkError:  # the upload may have been begun, only the answer was lost
        found = (yield calls.find_uploads(scan.sha256)).uploads
        if not found:
            raise
    best: UploadView = next((upload for upload in found if upload.id == known_id), found[0])
    return best


def _may_pass(error: ClientError) -> bool:
    """Tell whether it is trouble of the line or of the server, or an upload that is not where it was thought to be."""
    timed_out = isinstance(error, ApiError) and error.status == TIMED_OUT
    return calls.is_passing(error) or isinstance(error, ConflictError) or timed_out
