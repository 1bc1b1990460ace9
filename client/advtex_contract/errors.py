"""The one error body, the codes that a program may act on, and the catalogue that says what each means."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from typing import Literal, NamedTuple

from pydantic import BaseModel, Field, computed_field


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


class Explanation(NamedTuple):
    """Why an error comes, and what helps."""

    cause: str
    remedy: str


EXPLANATIONS: Mapping[ErrorCode, Explanation] = {
    ErrorCode.bad_request: Explanation(
        "The request is not one that this server knows: its JSON, a header, a parameter or the order of the calls.",
        "Correct what the details name; the description of the API lists what is accepted.",
    ),
    ErrorCode.invalid_options: Explanation(
        "An option of the job has a name or a value that this server does not accept.",
        "Correct the options that the details name. A newer client may know options that an older server does not.",
    ),
    ErrorCode.invalid_scan: Explanation(
        "The scan cannot be textured: a file is missing or broken, or what is in it cannot be right.",
        "Mend what the details name; `advtex-client check` finds the same before anything is sent.",
    ),
    ErrorCode.invalid_source: Explanation(
        "The scan was given by reference, and its address is outside of what the operator allows, or cannot be read.",
        "Check the address and who may read it, ask the operator to allow it, or upload the scan.",
    ),
    ErrorCode.unauthorized: Explanation(
        "There is no key, or it is unknown, revoked or expired.",
        "Send `Authorization: Bearer adv_...` with a key that is in force.",
    ),
    ErrorCode.forbidden: Explanation(
        "The key lacks the scope for this, or the request came from a page of another site.",
        "Use a key with the scope that the message names, or ask the operator for one.",
    ),
    ErrorCode.not_found: Explanation(
        "There is no such path, job, upload, batch or file, it was deleted, or it belongs to another owner.",
        "Check the address and the key. What was kept for its time is gone.",
    ),
    ErrorCode.conflict: Explanation(
        "What was asked for does not go with the state it is in: a job that has ended is canceled, or bytes of an "
        "upload come from two sides.",
        "Look at its present state, and decide anew.",
    ),
    ErrorCode.idempotency_in_flight: Explanation(
        "The first request with this Idempotency-Key is still being answered.",
        "Repeat the same request in a second.",
    ),
    ErrorCode.idempotency_mismatch: Explanation(
        "The Idempotency-Key was used before with another body.", "Use a new key for another request."
    ),
    ErrorCode.not_ready: Explanation(
        "What is asked for is not there yet: the upload is not complete, or the job has no such file so far.",
        "Ask again once it is complete; the job's events say when.",
    ),
    ErrorCode.precondition_failed: Explanation(
        "The request's condition does not hold: most often, `Tus-Resumable` is missing or is not 1.0.0.",
        "Send what the message names.",
    ),
    ErrorCode.checksum_mismatch: Explanation(
        "The bytes that arrived do not have the checksum that was sent with them.",
        "Send them again; where it happens again, the file changed after its checksum was made.",
    ),
    ErrorCode.too_large: Explanation(
        "The body, or the scan, is larger than the server accepts.",
        "`GET /v1/storage` tells the limits. Send fewer or smaller frames, or ask the operator.",
    ),
    ErrorCode.quota_exceeded: Explanation(
        "The owner has as many jobs or bytes as are allowed.",
        "Wait for jobs to end, delete uploads and jobs, or ask the operator for more. `GET /v1/key` tells the quotas.",
    ),
    ErrorCode.rate_limited: Explanation(
        "Too many wrong keys came from this address.", "Wait for as long as Retry-After says, and check the key."
    ),
    ErrorCode.insufficient_storage: Explanation(
        "The server's disk has no room left for it. Nothing that was accepted is touched.",
        "Try again later; the operator has to make room.",
    ),
    ErrorCode.unavailable: Explanation(
        "The database, Redis or the storage does not answer at the moment.",
        "Repeat the request in a few seconds; `GET /readyz` says what does not work.",
    ),
    ErrorCode.internal: Explanation(
        "A fault of the server. Its log has the reason.", "Try again; if it stays, tell the operator when it was."
    ),
}
JOB_EXPLANATIONS: Mapping[str, Explanation] = {
    "invalid_scan": EXPLANATIONS[ErrorCode.invalid_scan],
    "invalid_options": EXPLANATIONS[ErrorCode.invalid_options],
    "scan_missing": Explanation(
        "The scan's bytes are gone from the storage, or from the place that was referred to.",
        "Send the scan again, or put it back where it was and retry the job.",
    ),
    "scan_damaged": Explanation(
        "The storage holds other bytes of the scan than those that were uploaded.",
        "Send the scan again, and tell the operator: the storage has lost or changed what it was given.",
    ),
    "storage_refused": Explanation(
        "The storage keeps refusing: permission denied, or a bucket or folder that does not exist.",
        "The operator has to mend the storage; then retry the job.",
    ),
    "check_died": Explanation(
        "The process that checks scans died of this one several times.",
        "Look for images or a mesh of absurd size in the scan; the server's log has more.",
    ),
    "out_of_memory": Explanation(
        "The engine needed more memory than its worker has.",
        "Ask for a smaller size, fewer views or a smaller texture, or have a larger worker; then retry the job.",
    ),
    "engine_error": Explanation(
        "The engine failed, or came to no finite texture. The job's log tail has the reason.",
        "Retry the job: it goes on from its last checkpoint. If it fails again, report it with the log tail.",
    ),
    "poison": Explanation(
        "The engine's process died in every attempt: workers took turns, and none survived it.",
        "Ask for a smaller size or fewer views; the job's log tail has what it said last.",
    ),
    "results_lost": Explanation(
        "The job had succeeded, but its files are gone from the storage, or the list of them is damaged.",
        "Retry the job, or have the operator restore the storage from its backup.",
    ),
}
"""How a job can end without success, by `JobError.code`. Methods of other packages may have codes of their own."""


class ErrorDetail(BaseModel):
    """One problem: where it is (a field or a file of the scan) and what helps."""

    severity: Literal["error", "warning", "info"] = "error"
    code: str = ""
    where: str = ""
    message: str
    remedy: str = ""


class ErrorBody(BaseModel):
    """The body of every 4xx and 5xx answer.

    help: where the server explains the code, a path on it.
    """

    code: ErrorCode
    message: str
    details: list[ErrorDetail] = Field(default_factory=list)

    @computed_field  # type: ignore[prop-decorator]
    @property
    def help(self) -> str:
        return f"/errors#{self.code}"
