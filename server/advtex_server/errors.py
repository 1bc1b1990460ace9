"""Every failure becomes the one error body, here and nowhere else."""

from __future__ import annotations

from collections.abc import Mapping

import structlog
from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from sqlalchemy.exc import DBAPIError
from sqlalchemy.exc import TimeoutError as PoolTimeoutError
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.types import Scope

from advtex_contract.errors import ErrorCode, ErrorDetail
from advtex_server.refusal import ApiError
from advtex_store import errors as store

STORE_CODES: Mapping[type[store.StoreError], ErrorCode] = {
    store.RecordNotFound: ErrorCode.not_found,
    store.ReferenceRefused: ErrorCode.invalid_source,
    store.ReferenceUnreadable: ErrorCode.invalid_source,
    store.BlobNotFound: ErrorCode.not_found,
    store.IllegalTransition: ErrorCode.conflict,
    store.StaleAttempt: ErrorCode.conflict,
    store.Superseded: ErrorCode.conflict,
    store.IdempotencyMismatch: ErrorCode.idempotency_mismatch,
    store.IdempotencyInFlight: ErrorCode.idempotency_in_flight,
    store.NoSpace: ErrorCode.insufficient_storage,
    store.BlobsUnavailable: ErrorCode.unavailable,
    store.BlobsRefused: ErrorCode.unavailable,
    store.QuotaExceeded: ErrorCode.quota_exceeded,
}
HTTP_CODES: Mapping[int, ErrorCode] = {
    401: ErrorCode.unauthorized,
    403: ErrorCode.forbidden,
    404: ErrorCode.not_found,
    409: ErrorCode.conflict,
    412: ErrorCode.precondition_failed,
    413: ErrorCode.too_large,
    429: ErrorCode.rate_limited,
    503: ErrorCode.unavailable,
}
REMEDIES = {  # by pydantic's type of error
    "extra_forbidden": "correct the name or leave it out; /openapi.json lists what is accepted",
    "missing": "add it; /openapi.json describes it",
    "json_invalid": "send well-formed JSON",
}
RETRY_AFTER = {ErrorCode.unavailable: "5", ErrorCode.idempotency_in_flight: "1", ErrorCode.insufficient_storage: "60"}

log = structlog.get_logger("advtex.server")


def answer(error: ApiError) -> JSONResponse:
    """The response that says it."""
    headers = dict(error.headers)
    if (seconds := RETRY_AFTER.get(error.body.code)) is not None:
        headers.setdefault("Retry-After", seconds)
    if error.status == 401:
        headers.setdefault("WWW-Authenticate", 'Bearer realm="advtex"')
    return JSONResponse(error.body.model_dump(mode="json"), error.status, headers)


def translated(error: Exception) -> ApiError:
    """What users are told about an exception. Anything unknown is `internal`, without its text."""
    match error:
        case ApiError():
            return error
        case store.StoreError():
            return ApiError(STORE_CODES.get(type(error), ErrorCode.internal), str(error))
        case RequestValidationError():
            return _validation(error)
        case HTTPException():
            code = HTTP_CODES.get(error.status_code, ErrorCode.bad_request)
            if error.status_code >= 500 and code is ErrorCode.bad_request:
                code = ErrorCode.internal
            return ApiError(code, str(error.detail), status=error.status_code, headers=error.headers)
        case ClientDisconnect():
            return ApiError(ErrorCode.bad_request, "the line broke before the whole body had come")
        case DBAPIError() | PoolTimeoutError():
            return ApiError(ErrorCode.unavailable, "the database cannot be reached at the moment; try again")
        case _:
            return ApiError(ErrorCode.internal, "something went wrong in the server; its log says what")


def respond(scope: Scope, error: Exception) -> JSONResponse:
    """The answer to a request that ended in an exception."""
    return answer(noted(scope, error))


def noted(scope: Scope, error: Exception) -> ApiError:
    """What its user is told; what is the server's fault is logged."""
    told = translated(error)
    if told.status >= 500:
        log.error("request failed", method=scope["method"], path=scope["path"], code=told.body.code, exc_info=error)
    return told


def install(app: FastAPI) -> None:
    """Let every exception of a route end in the one body."""

    async def handle(request: Request, error: Exception) -> JSONResponse:
        return respond(request.scope, error)

    for kind in (
        ApiError,
        ClientDisconnect,
        store.StoreError,
        RequestValidationError,
        HTTPException,
        DBAPIError,
        PoolTimeoutError,
        Exception,
    ):
        app.add_exception_handler(kind, handle)


def _validation(error: RequestValidationError) -> ApiError:
    details = [
        ErrorDetail(
            code=str(e["type"]),
            where=".".join(str(part) for part in e["loc"]),
            message=str(e["msg"]),
            remedy=REMEDIES.get(str(e["type"]), "correct the value; /openapi.json lists what is accepted"),
        )
        for e in error.errors()
    ]
    options = any("options" in e["loc"] for e in error.errors())
    code = ErrorCode.invalid_options if options else ErrorCode.bad_request
    first = details[0]
    return ApiError(code, f"{first.where}: {first.message}", details, status=422)
