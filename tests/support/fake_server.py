"""The server's API in memory, as an httpx transport, with faults to order."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from collections.abc import Callable, Iterator
from datetime import UTC, datetime

import httpx
from pydantic import BaseModel

from advtex_contract.errors import ErrorBody, ErrorCode
from advtex_contract.health import Alive, KeyView, PartView, Readiness
from advtex_contract.jobs import JobSpec, JobState, JobView, Progress, ResultFile, UploadList, UploadView

NOW = datetime(2026, 1, 1, tzinfo=UTC)
Fault = Callable[[httpx.Request], httpx.Response]


class FakeServer:
    """`transport` serves jobs, uploads and results; `faults` are used up, one per request, before anything else."""

    def __init__(self) -> None:
        self.uploads: dict[str, UploadView] = {}
        self.bytes: dict[str, bytes] = {}
        self.announced: dict[str, str] = {}
        self.begun = 0
        self.received = 0
        self.jobs: dict[str, JobView] = {}
        self.keys: dict[str, tuple[str, str]] = {}
        self.results: dict[str, bytes] = {}
        self.requests: list[httpx.Request] = []
        self.faults: list[Fault] = []
        self.script: list[JobView] = []
        self.begins = JobState.queued  # what new jobs are
        self.events = False
        self.readiness = Readiness(ready=True, checks={"database": PartView(ok=True, essential=True)})
        self.key = KeyView(id="0123", scopes=["read", "write"], active_jobs=0, bytes=0)
        self.transport = httpx.MockTransport(self.handle)

    def handle(self, request: httpx.Request) -> httpx.Response:
        request.read()
        self.requests.append(request)
        return self.faults.pop(0)(request) if self.faults else self.answer(request)

    def answer(self, request: httpx.Request) -> httpx.Response:
        """As it is meant to be; as a fault, it leaves one request alone."""
        path, body = request.url.path, request.content
        if path == "/healthz":
            return ok(Alive())
        if path == "/readyz":
            return ok(self.readiness, 200 if self.readiness.ready else 503)
        if path == "/v1/key":
            return ok(self.key)
        if path == "/v1/uploads":
            return self._begin(request) if request.method == "POST" else self._find(request.url.params["sha256"])
        if match := re.fullmatch(r"/v1/uploads/(\w+)", path):
            return self._upload(request, match[1], body)
        if path == "/v1/jobs" and request.method == "POST":
            return self._create(request, body)
        if match := re.fullmatch(r"/v1/jobs/([\w-]+)(/\w+)?(?:/(.+))?", path):
            return self._job(request, *match.groups())
        return error(404, ErrorCode.not_found)

    def count(self, method: str, path: str) -> int:
        return sum(r.method == method and r.url.path == path for r in self.requests)

    def finish(self, job_id: str, files: dict[str, bytes]) -> JobView:
        """The job has succeeded with these results."""
        self.results = files
        found = [
            ResultFile(
                name=name,
                size=len(data),
                sha256=hashlib.sha256(data).hexdigest(),
                content_type="x/y",
                url=f"/v1/jobs/{job_id}/results/{name}",
            )
            for name, data in files.items()
        ]
        self.jobs[job_id] = self.jobs[job_id].model_copy(update={"state": JobState.succeeded, "results": found})
        return self.jobs[job_id]

    def _begin(self, request: httpx.Request) -> httpx.Response:
        assert request.headers["Tus-Resumable"] == "1.0.0"
        pairs = dict(pair.split(" ") for pair in request.headers["Upload-Metadata"].split(","))
        given = {name: base64.b64decode(value).decode() for name, value in pairs.items()}
        name = f"u{self.begun}"
        self.begun += 1
        self.uploads[name] = UploadView(
            id=name,
            size=int(request.headers["Upload-Length"]),
            offset=0,
            complete=False,
            filename=given["filename"],
            created_at=NOW,
        )
        self.bytes[name], self.announced[name] = b"", given["sha256"]
        return ok(self.uploads[name], 201)

    def _find(self, sha256: str) -> httpx.Response:
        found = [upload for name, upload in self.uploads.items() if self.announced[name] == sha256]
        return ok(UploadList(uploads=sorted(found, key=lambda upload: (not upload.complete, -upload.offset))))

    def _upload(self, request: httpx.Request, name: str, body: bytes) -> httpx.Response:
        if name not in self.uploads:
            return error(404, ErrorCode.not_found)
        if request.method == "PATCH":
            if int(request.headers["Upload-Offset"]) != len(self.bytes[name]):
                return error(409, ErrorCode.conflict)
            assert len(body) == int(request.headers["Content-Length"])
            self.keep(name, body)
        elif request.method != "HEAD":
            return ok(self.uploads[name])
        status = 204 if request.method == "PATCH" else 200
        return httpx.Response(status, headers={"Upload-Offset": str(self.uploads[name].offset)})

    def keep(self, name: str, data: bytes) -> None:
        """These bytes arrived."""
        self.bytes[name] += data
        self.received += len(data)
        whole = len(self.bytes[name]) == self.uploads[name].size
        sha256 = hashlib.sha256(self.bytes[name]).hexdigest() if whole else None
        self.uploads[name] = self.uploads[name].model_copy(
            update={"offset": len(self.bytes[name]), "complete": whole, "sha256": sha256}
        )

    def _create(self, request: httpx.Request, body: bytes) -> httpx.Response:
        key = request.headers["Idempotency-Key"]
        if key in self.keys:
            earlier, job_id = self.keys[key]
            return ok(self.jobs[job_id]) if earlier == body.decode() else error(422, ErrorCode.idempotency_mismatch)
        spec = JobSpec.model_validate_json(body)
        asked = {"options": spec.options, "label": spec.label, "batch": spec.batch}
        job = view(f"j{len(self.jobs)}", self.begins, upload_id=spec.upload_id, **asked)
        job.retention_seconds = spec.retention_seconds or 0
        self.jobs[job.id] = job
        self.keys[key] = (body.decode(), job.id)
        return ok(job, 201)

    def _job(self, request: httpx.Request, job_id: str, action: str | None, name: str | None) -> httpx.Response:
        if job_id not in self.jobs:
            return error(404, ErrorCode.not_found)
        if action == "/results" and name is not None:
            return self._result(request, name)
        if action == "/events":
            return self._events() if self.events else error(404, ErrorCode.not_found)
        if self.script and request.method == "GET":
            self.jobs[job_id] = self.script.pop(0)
        if request.method == "DELETE":
            del self.jobs[job_id]
            return httpx.Response(204)
        return ok(self.jobs[job_id])

    def _events(self) -> httpx.Response:
        blocks = [f"id: {i}\nevent: job\ndata: {job.model_dump_json()}\n\n" for i, job in enumerate(self.script, 1)]
        ping = ': ping\n\nid: 9\nevent: state\ndata: {"kind": "state"}\n\n'
        return httpx.Response(200, headers={"Content-Type": "text/event-stream"}, text=ping + "".join(blocks))

    def _result(self, request: httpx.Request, name: str) -> httpx.Response:
        data = self.results[name]
        etag = f'"{hashlib.sha256(data).hexdigest()}"'
        headers = {"ETag": etag}
        match = re.fullmatch(r"bytes=(\d+)-", request.headers.get("Range", ""))
        if match and request.headers.get("If-Range") in (None, etag):
            start = int(match[1])
            headers["Content-Range"] = f"bytes {start}-{len(data) - 1}/{len(data)}"
            return httpx.Response(206, headers=headers, content=data[start:])
        return httpx.Response(200, headers=headers, content=data)


def view(job_id: str, state: JobState = JobState.queued, step: int = 0, **fields: object) -> JobView:
    values = {"upload_id": "u0", "options": {}, "created_at": NOW, "updated_at": NOW} | fields
    return JobView.model_validate({"id": job_id, "state": state, "progress": Progress(step=step)} | values)


def ok(model: BaseModel, status: int = 200) -> httpx.Response:
    return httpx.Response(status, json=json.loads(model.model_dump_json()))


def error(status: int, code: ErrorCode, headers: dict[str, str] | None = None) -> httpx.Response:
    body = ErrorBody(code=code, message=f"this is a {code}").model_dump(mode="json")
    return httpx.Response(status, json=body, headers=headers)


def refuses(request: httpx.Request) -> httpx.Response:
    raise httpx.ConnectError("connection refused", request=request)


def breaks(request: httpx.Request) -> httpx.Response:
    raise httpx.ReadError("connection reset", request=request)


def cuts_off_after(server: FakeServer, length: int) -> Fault:
    """The line breaks after `length` bytes of a piece, which the server keeps."""

    def fault(request: httpx.Request) -> httpx.Response:
        assert request.method == "PATCH"
        server.keep(request.url.path.rpartition("/")[2], request.content[:length])
        raise httpx.WriteError("connection reset", request=request)

    return fault


def answers(status: int, code: ErrorCode = ErrorCode.unavailable) -> Fault:
    return lambda _request: error(status, code)


class CutOff(httpx.SyncByteStream):
    """A body that ends before its time, with the loss of the connection."""

    def __init__(self, data: bytes, request: httpx.Request) -> None:
        self._data = data
        self._request = request

    def __iter__(self) -> Iterator[bytes]:
        yield self._data
        raise httpx.RemoteProtocolError("peer closed connection", request=self._request)


def cuts_off(data: bytes) -> Fault:
    """Answers 200 with `data` and then loses the connection."""
    return lambda request: httpx.Response(200, stream=CutOff(data, request))
