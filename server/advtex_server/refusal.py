"""A request that is refused, with the code that a program can act on. Knows no web framework."""

from __future__ import annotations

from collections.abc import Mapping

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


class ApiError(Exception):
    """A refusal with its code; `status` only where it differs from the code's usual one."""

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
        self.body = ErrorBody(code=code, message=message, details=details or [])
        self.status = status or STATUS[code]
        self.headers = dict(headers or {})
