"""The one error body, and the codes that a program may act on."""

from __future__ import annotations

from enum import StrEnum
from typing import Literal

from pydantic import BaseModel, Field


class ErrorCode(StrEnum):
    """Stable names; each maps to one HTTP status in the server."""

    bad_request = "bad_request"
    invalid_options = "invalid_options"
    invalid_scan = "invalid_scan"
    invalid_source = "invalid_source"
    unauthorized = "unauthorized"
    forbidden = "forbidden"
    not_found = "not_found"
    conflict = "conflict"
    idempotency_in_flight = "idempotency_in_flight"
    idempotency_mismatch = "idempotency_mismatch"
    not_ready = "not_ready"
    precondition_failed = "precondition_failed"
    checksum_mismatch = "checksum_mismatch"
    too_large = "too_large"
    quota_exceeded = "quota_exceeded"
    rate_limited = "rate_limited"
    insufficient_storage = "insufficient_storage"
    unavailable = "unavailable"
    internal = "internal"


class ErrorDetail(BaseModel):
    """One problem: where it is (a field or a file of the scan) and what helps."""

    severity: Literal["error", "warning", "info"] = "error"
    code: str = ""
    where: str = ""
    message: str
    remedy: str = ""


class ErrorBody(BaseModel):
    """The body of every 4xx and 5xx answer."""

    code: ErrorCode
    message: str
    details: list[ErrorDetail] = Field(default_factory=list)
