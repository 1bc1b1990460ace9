"""What can go wrong, from the caller's side.

ClientError
├── ConfigError          no server address or no key is configured, or the configuration file is broken
├── ScanRejectedError    the scan cannot be textured: the check found errors, or the server rejected the job
├── NetworkError         no answer: name, route, refused, reset, silence
├── WaitTimeoutError     the wait ended before the job did; the job goes on
├── IntegrityError       a download does not match its sha256, or its name is unsafe
├── JobFailedError       the job ended as failed or canceled
└── ApiError             the server answered with an error body
    ├── AuthError            401, 403
    ├── NotFoundError        404
    ├── ConflictError        409, 412
    ├── InvalidRequestError  400, 413, 422
    ├── BusyError            429, 507: a quota, a rate or the disk is at its limit
    └── ServerError          every other answer
"""

from __future__ import annotations

from collections.abc import Sequence

import httpx
from pydantic import ValidationError

from advtex_contract.errors import ErrorBody, ErrorCode, ErrorDetail
from advtex_contract.jobs import JobView


class ClientError(Exception):
    """The base of everything that this package raises on purpose. The message names the input and the remedy."""

    code = "client_error"
    details: Sequence[ErrorDetail] = ()


class ConfigError(ClientError):
    """No server address or no key is configured, or the configuration file is broken."""

    code = "config"


class ScanRejectedError(ClientError):
    """The scan cannot be textured. `details` list every problem with its file and remedy."""

    code = "invalid_scan"

    def __init__(self, message: str, details: Sequence[ErrorDetail] = (), job: JobView | None = None) -> None:
        super().__init__(message)
        self.details = tuple(details)
        self.job = job


class NetworkError(ClientError):
    """The server did not answer. That says nothing about any job."""

    code = "network"


class WaitTimeoutError(ClientError):
    """The wait ended before the job did. The job goes on; `job` is how it was last seen."""

    code = "timeout"

    def __init__(self, message: str, job: JobView | None = None) -> None:
        super().__init__(message)
        self.job = job


class IntegrityError(ClientError):
    """A download does not match its sha256, or the server named a file outside of the target folder."""

    code = "integrity"


class JobFailedError(ClientError):
    """The job ended as failed or canceled."""

    code = "job_failed"

    def __init__(self, message: str, job: JobView) -> None:
        super().__init__(message)
        self.job = job
        self.details = tuple(job.error.details) if job.error else ()


class ApiError(ClientError):
    """The server answered with an error. `status` is the HTTP status, `error` the body."""

    def __init__(self, status: int, error: ErrorBody) -> None:
        super().__init__(f"{error.message} ({error.code}, HTTP {status})")
        self.status = status
        self.error = error
        self.code = error.code.value
        self.details = tuple(error.details)


class AuthError(ApiError):
    """The key is missing, wrong, expired or lacks the scope."""


class NotFoundError(ApiError):
    """There is no such job, upload or result that this key may see."""


class ConflictError(ApiError):
    """The state of the job, or another request with the same key, stands in the way."""


class InvalidRequestError(ApiError):
    """The request was understood and refused: an option, the size or the body."""


class BusyError(ApiError):
    """A quota, a rate or the disk is at its limit; later it may pass."""


class ServerError(ApiError):
    """The server could not do its part."""


_BY_STATUS: dict[int, type[ApiError]] = {
    400: InvalidRequestError,
    401: AuthError,
    403: AuthError,
    404: NotFoundError,
    409: ConflictError,
    412: ConflictError,
    413: InvalidRequestError,
    422: InvalidRequestError,
    429: BusyError,
    507: BusyError,
}


def error_from_response(response: httpx.Response) -> ApiError:
    """Return the exception for a 4xx or 5xx answer whose body has been read; a proxy's page is told apart."""
    try:
        error = ErrorBody.model_validate_json(response.content)
    except ValidationError:
        text = response.text.strip()[:200] or response.reason_phrase
        error = ErrorBody(
            code=ErrorCode.unavailable, message=f"{response.request.url} did not answer as advtex: {text}"
        )
    if error.code in (ErrorCode.idempotency_in_flight, ErrorCode.idempotency_mismatch):
        return ConflictError(response.status_code, error)
    return _BY_STATUS.get(response.status_code, ServerError)(response.status_code, error)
