"""A request that is refused, with the code that a program can act on. Knows no web framework."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from advtex_contract.errors import ErrorBody, ErrorCode, ErrorDetail

STATUS: Mapping[ErrorCode, int] = {
    ErrorCode.bad_request: 400,
    ErrorCode.invalid_options: 422,
    ErrorCode.invalid_scan: 422,
    ErrorCode.invalid_source: 422,
    ErrorCode.unauthorized: 401,
    ErrorCode.forbidden: 403,
    ErrorCode.not_found: 404,
    ErrorCode.conflict: 409,
    ErrorCode.idempotency_in_flight: 409,
    ErrorCode.idempotency_mismatch: 422,
    ErrorCode.not_ready: 409,
    ErrorCode.precondition_failed: 412,
    ErrorCode.checksum_mismatch: 422,
    ErrorCode.too_large: 413,
    ErrorCode.quota_exceeded: 429,
    ErrorCode.rate_limited: 429,
    ErrorCode.insufficient_storage: 507,
    ErrorCode.unavailable: 503,
    ErrorCode.internal: 500,
}
SPECIAL: Mapping[int, str] = {
    408: "nothing came for too long",
    411: "there is no Content-Length",
    415: "another Content-Type is needed",
    416: "the range is beyond the end",
    422: "a value that is not accepted",
    460: "the bytes do not fit their Upload-Checksum",
}
"""Statuses that are not the usual one of their code, and what they say."""


REMEDIES: Mapping[ErrorCode, tuple[str, str]] = {
    ErrorCode.idempotency_in_flight: ("Idempotency-Key", "repeat the same request in a second"),
    ErrorCode.idempotency_mismatch: ("Idempotency-Key", "use a new key for another request"),
    ErrorCode.quota_exceeded: ("the key's quota", "wait for jobs to end, delete uploads, or ask the operator for more"),
    ErrorCode.insufficient_storage: ("the server's disk", "try again later; the operator has to make room"),
    ErrorCode.unavailable: ("the server", "try again in a few seconds; GET /readyz says what does not work"),
}
"""Where, and what helps, for refusals that no single field or file is to blame for."""


class ApiError(Exception):
    """A refusal with its code; `status` only where it differs from the code's usual one, `details` from REMEDIES."""

    def __init__(
        self,
        code: ErrorCode,
        message: str,
        details: list[ErrorDetail] | None = None,
        *,
        status: int | None = None,
        headers: Mapping[str, str] | None = None,
    ) -> None:
        super().__init__(message)
        if not details and code in REMEDIES:
            where, remedy = REMEDIES[code]
            details = [ErrorDetail(code=code, where=where, message=message, remedy=remedy)]
        self.body = ErrorBody(code=code, message=message, details=details or [])
        self.status = status or STATUS[code]
        self.headers = dict(headers or {})


def refuses(*reasons: ErrorCode | int) -> dict[int | str, dict[str, Any]]:
    """Refusals as a route's description has them: codes, and statuses of `SPECIAL`."""
    found: dict[int, list[str]] = {}
    for reason in reasons:
        status = STATUS[reason] if isinstance(reason, ErrorCode) else reason
        found.setdefault(status, []).append(reason.value if isinstance(reason, ErrorCode) else SPECIAL[reason])
    return {status: {"model": ErrorBody, "description": "; ".join(said)} for status, said in found.items()}


ANYWHERE = refuses(ErrorCode.too_large, ErrorCode.internal, ErrorCode.unavailable)
WITH_KEY = refuses(ErrorCode.unauthorized, ErrorCode.forbidden, ErrorCode.rate_limited)
