"""The calls of the API as plain values, so that the sync and the async client only differ in how they send them."""

from __future__ import annotations

import base64
import random
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Generic, TypeVar
from urllib.parse import quote

import httpx
from pydantic import BaseModel, ValidationError

from advtex_client.errors import (
    ApiError,
    BusyError,
    ClientError,
    JobFailedError,
    NetworkError,
    ScanRejectedError,
    error_from_response,
)
from advtex_client.uploads import FileStream, PackedScan
from advtex_contract.errors import ErrorCode
from advtex_contract.health import Alive, KeyView, Readiness
from advtex_contract.jobs import (
    TERMINAL,
    BatchLimits,
    BatchPage,
    BatchView,
    JobPage,
    JobSpec,
    JobState,
    JobView,
    ResultFile,
    UploadList,
    UploadView,
)
from advtex_options.outputs import kind_and_purpose

T = TypeVar("T")
M = TypeVar("M", bound=BaseModel)

TRANSIENT = frozenset({502, 504})
REFUSED = frozenset({429, 503})
TUS = {"Tus-Resumable": "1.0.0"}
NEVER_SENT = (httpx.ConnectError, httpx.ConnectTimeout, httpx.PoolTimeout)


@dataclass(frozen=True)
class Call(Generic[T]):
    """One request and how its answer is read. Only an idempotent one is sent again when its fate is unknown."""

    method: str
    path: str
    parse: Callable[[httpx.Response], T]
    idempotent: bool = True
    json: object = None
    params: Mapping[str, str | int] = field(default_factory=dict)
    headers: Mapping[str, str] = field(default_factory=dict)
    body: FileStream | None = None


@dataclass(frozen=True)
class Pause:
    """A wait of `seconds` before the next call."""

    seconds: float


def alive() -> Call[Alive]:
    return Call("GET", "/healthz", reader(Alive))


def readiness() -> Call[Readiness]:
    return Call("GET", "/readyz", _readiness)


def get_key() -> Call[KeyView]:
    return Call("GET", "/v1/key", reader(KeyView))


def get_job(job_id: str) -> Call[JobView]:
    return Call("GET", _job(job_id), reader(JobView))


def create_job(spec: JobSpec, idempotency_key: str) -> Call[JobView]:
    body = spec.model_dump(mode="json")
    return Call("POST", "/v1/jobs", reader(JobView), json=body, headers={"Idempotency-Key": idempotency_key})


def cancel_job(job_id: str) -> Call[JobView]:
    return Call("POST", f"{_job(job_id)}/cancel", reader(JobView))


def retry_job(job_id: str) -> Call[JobView]:
    return Call("POST", f"{_job(job_id)}/retry", reader(JobView), idempotent=False)


def delete_job(job_id: str) -> Call[None]:
    return Call("DELETE", _job(job_id), _nothing)


def list_jobs(
    state: JobState | None, label: str | None, batch: str | None, limit: int, cursor: str | None
) -> Call[JobPage]:
    given: dict[str, str | int | None] = {"state": state, "label": label, "batch": batch}
    given |= {"limit": limit, "cursor": cursor}
    return Call("GET", "/v1/jobs", reader(JobPage), params={k: v for k, v in given.items() if v is not None})


def get_upload(upload_id: str) -> Call[UploadView]:
    return Call("GET", _upload(upload_id), reader(UploadView))


def get_batch(batch_id: str) -> Call[BatchView]:
    return Call("GET", _batch(batch_id), reader(BatchView))


def list_batches(limit: int, cursor: str | None) -> Call[BatchPage]:
    params: dict[str, str | int] = {"limit": limit} if cursor is None else {"limit": limit, "cursor": cursor}
    return Call("GET", "/v1/batches", reader(BatchPage), params=params)


def cancel_batch(batch_id: str) -> Call[BatchView]:
    return Call("POST", f"{_batch(batch_id)}/cancel", reader(BatchView))


def pause_batch(batch_id: str, paused: bool) -> Call[BatchView]:
    return Call("POST", f"{_batch(batch_id)}/{'pause' if paused else 'resume'}", reader(BatchView))


def limit_batch(batch_id: str, limits: BatchLimits) -> Call[None]:
    return Call("PUT", f"{_batch(batch_id)}/limits", _nothing, json=limits.model_dump(mode="json"))


def retry_batch(batch_id: str) -> Call[BatchView]:
    return Call("POST", f"{_batch(batch_id)}/retry-failed", reader(BatchView), idempotent=False)


def find_uploads(sha256: str) -> Call[UploadList]:
    """Ask what the server holds of these bytes."""
    return Call("GET", "/v1/uploads", reader(UploadList), params={"sha256": sha256})


def begin_upload(scan: PackedScan) -> Call[UploadView]:
    """Begin a resumable upload (tus 1.0.0). It is not sent again blindly: the server holds room for every one begun."""
    given = {"filename": scan.filename, "sha256": scan.sha256}
    pairs = (f"{name} {base64.b64encode(value.encode()).decode()}" for name, value in given.items())
    headers = TUS | {"Upload-Length": str(scan.size), "Upload-Metadata": ",".join(pairs)}
    return Call("POST", "/v1/uploads", reader(UploadView), idempotent=False, headers=headers)


def upload_offset(upload_id: str) -> Call[int]:
    """Ask where to go on, once the line broke."""
    return Call("HEAD", _upload(upload_id), _offset, headers=TUS)


def send_piece(upload_id: str, piece: FileStream) -> Call[int]:
    """Send bytes of an upload; the answer is the new offset. It is not sent again as it is: first the server must say
    how much of it came."""
    headers = TUS | {
        "Content-Type": "application/offset+octet-stream",
        "Content-Length": str(piece.stop - piece.start),
        "Upload-Offset": str(piece.start),
    }
    return Call("PATCH", _upload(upload_id), _offset, idempotent=False, headers=headers, body=piece)


def events_path(job_id: str) -> str:
    return f"{_job(job_id)}/events"


def _upload(upload_id: str) -> str:
    return f"/v1/uploads/{quote(upload_id, safe='')}"


def _batch(batch_id: str) -> str:
    return f"/v1/batches/{quote(batch_id, safe='')}"


def _job(job_id: str) -> str:
    return f"/v1/jobs/{quote(job_id, safe='')}"


def reader(model: type[M]) -> Callable[[httpx.Response], M]:
    """Return what reads a success's body as `model`, and raises ApiError or ClientError for any other answer."""

    def read(response: httpx.Response) -> M:
        raise_for_error(response)
        try:
            return model.model_validate_json(response.content)
        except ValidationError as error:
            raise ClientError(
                f"{response.request.url} answered with something that is no {model.__name__}; "
                "client and server are of different versions, or the URL is not an advtex server's"
            ) from error

    return read


def _readiness(response: httpx.Response) -> Readiness:
    """Read the answer of either status: a 503 has the same body, with what is wrong."""
    if response.status_code == 503:
        with suppress(ValidationError):
            return Readiness.model_validate_json(response.content)
    return reader(Readiness)(response)


def _offset(response: httpx.Response) -> int:
    raise_for_error(response)
    offset = response.headers.get("Upload-Offset", "")
    if not offset.isdigit():
        raise ClientError(f"{response.request.url} does not say how much it holds; is it an advtex server?")
    return int(offset)


def _nothing(response: httpx.Response) -> None:
    raise_for_error(response)


def raise_for_error(response: httpx.Response) -> None:
    if not response.is_success:
        raise error_from_response(response)


class Attempts:
    """Decides whether a request is sent again, and after how many seconds: exponential, with full jitter."""

    def __init__(self, idempotent: bool, retries: int, base: float = 0.5, cap: float = 15.0) -> None:
        self._idempotent = idempotent
        self._left = retries
        self._base = base
        self._cap = cap
        self._made = 0

    def after_error(self, error: httpx.TransportError | ClientError) -> float:
        """Return the seconds to wait. Raises the error, as a ClientError, when it will not pass or there is nothing
        left to try."""
        again = (
            is_passing(error) if isinstance(error, ClientError) else self._idempotent or isinstance(error, NEVER_SENT)
        )
        if self._left > 0 and again:
            return self._delay()
        if isinstance(error, ClientError):
            raise error
        raise network_error(error) from error

    def after_response(self, response: httpx.Response) -> float | None:
        """Return the seconds to wait, None when the answer stands. 429 and 503 refuse before anything is done, so they
        are safe to repeat."""
        status = response.status_code
        again = status in REFUSED or (status in TRANSIENT and self._idempotent) or _in_flight(response)
        if self._left <= 0 or not again:
            return None
        delay = self._delay()
        asked = response.headers.get("Retry-After", "")
        return min(max(delay, float(asked)), 60.0) if asked.isdigit() else delay

    def _delay(self) -> float:
        self._left -= 1
        self._made += 1
        return random.uniform(0.5, 1.0) * min(self._cap, self._base * 2.0 ** (self._made - 1))  # noqa: S311  jitter


def _in_flight(response: httpx.Response) -> bool:
    """Tell whether the same idempotent request is being answered right now; its answer can be had a little later."""
    return response.status_code == 409 and error_from_response(response).error.code is ErrorCode.idempotency_in_flight


def network_error(error: httpx.TransportError) -> NetworkError:
    request = error.request if error._request is not None else None
    where = f"{request.url.scheme}://{request.url.netloc.decode()}" if request else "the server"
    return NetworkError(
        f"no answer from {where}: {str(error) or type(error).__name__}; check the address and that it runs"
    )


def is_passing(error: ClientError) -> bool:
    """Tell whether this is trouble of the line or the server that says nothing about a job and may be over soon."""
    return isinstance(error, (NetworkError, BusyError)) or (isinstance(error, ApiError) and error.status >= 500)


def chosen_results(job: JobView, names: Sequence[str] | None) -> list[ResultFile]:
    """Return the job's result files, all or the named ones. Raises ClientError when there are none to fetch."""
    if not job.results:
        raise ClientError(f"job {job.id} has no results ({job.state}); `watch` it until it has succeeded")
    by_name = {file.name: file for file in job.results}
    unknown = [name for name in names or () if name not in by_name]
    if unknown:
        raise ClientError(f"job {job.id} has no result {unknown[0]!r}; it has {', '.join(by_name)}")
    return [by_name[name] for name in names] if names else job.results


def only_results(job: JobView, words: str) -> list[str]:
    """Return the names of the results that any of `words` (with commas between) means, in the job's order.

    A word is a file's name, else a kind of file, else an ending. Raises ClientError for one that nothing matches.
    """
    chosen = set[str]()
    for word in (word.strip() for word in words.split(",")):
        means = (lambda file: file.name, _kind, lambda file: file.name.rpartition(".")[2])
        found = next(filter(None, ([file.name for file in job.results if mean(file) == word] for mean in means)), [])
        if not found and job.results:
            kinds = ", ".join(dict.fromkeys(filter(None, map(_kind, job.results))))
            raise ClientError(f"job {job.id} has no result {word!r}; give a file's name, its ending, or one of {kinds}")
        chosen.update(found)
    return [file.name for file in job.results if file.name in chosen]


def _kind(file: ResultFile) -> str:
    """Servers of older releases tell none."""
    return file.kind or kind_and_purpose(file.name)[0]


def ensure_succeeded(job: JobView) -> JobView:
    """Return the job itself if it succeeded. Raises ScanRejectedError or JobFailedError, which say how it ended."""
    reason = job.error.message if job.error else "no reason was given"
    if job.state is JobState.rejected:
        raise ScanRejectedError(f"job {job.id} was rejected: {reason}", job.error.details if job.error else (), job)
    if job.state is JobState.failed:
        raise JobFailedError(f"job {job.id} failed: {reason}", job)
    if job.state is JobState.canceled:
        raise JobFailedError(f"job {job.id} was canceled; `retry` goes on from its checkpoint", job)
    assert job.state in TERMINAL
    return job
