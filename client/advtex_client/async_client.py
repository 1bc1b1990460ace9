"""The client for asyncio programs: `AsyncClient`, method for method the same as `Client`.

`client.py` is made of this file: after a change, run `python client/make_sync_client.py`.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Generator, Sequence
from contextlib import ExitStack, suppress
from datetime import datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar

import anyio
import httpx
from anyio.to_thread import run_sync

from advtex_client import _calls as calls
from advtex_client._events import OnTrouble, Watch, is_event_stream
from advtex_client._http import LIMITS, TIMEOUT, base_headers, build, result_url
from advtex_client._sending import Step, sending
from advtex_client._submission import ensure_submittable, job_spec, submission
from advtex_client.config import load_config
from advtex_client.downloads import Download, OnFileBytes, is_there, target_path
from advtex_client.errors import ClientError, NotFoundError
from advtex_client.submissions import SubmissionMemory, upload_alone
from advtex_client.uploads import OnBytes, PackedScan, packed
from advtex_contract.health import KeyView, Readiness
from advtex_contract.jobs import BatchLimits, BatchView, JobSpec, JobState, JobView, ResultFile, UploadView
from advtex_contract.options import JobOptions

T = TypeVar("T")


class AsyncClient:
    """Talks to one advtex server. A context manager; every error is a `ClientError`.

    url, api_key    as in `load_config` when absent
    retries         how often a request is sent again after passing trouble; only idempotent ones are
    transport       an httpx transport, for tests
    """

    def __init__(
        self,
        url: str | None = None,
        api_key: str | None = None,
        *,
        retries: int = 4,
        transport: httpx.AsyncBaseTransport | None = None,
    ) -> None:
        self.config = load_config(url, api_key)
        self._retries = retries
        self._http = httpx.AsyncClient(
            base_url=self.config.url,
            headers=base_headers(self.config),
            timeout=TIMEOUT,
            limits=LIMITS,
            transport=transport,
        )

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    async def close(self) -> None:
        """Close the connections, as leaving the context does."""
        await self._http.aclose()

    async def ping(self) -> None:
        """Raise a ClientError unless an advtex server answers."""
        await self._run(calls.alive(), retries=0)

    async def readiness(self) -> Readiness:
        """Return whether the server can accept work, and how each of its parts is."""
        return await self._run(calls.readiness(), retries=0)

    async def get_key(self) -> KeyView:
        """Return what this client's key may do."""
        return await self._run(calls.get_key(), retries=0)

    async def upload(self, scan: Path, *, on_bytes: OnBytes | None = None) -> UploadView:
        """Send a scan, zip or folder."""
        with ExitStack() as stack:
            archive = await run_sync(stack.enter_context, packed(scan))
            await run_sync(stack.enter_context, upload_alone(self.config.url, archive.sha256))
            return await self._drive(sending(archive, self._retries, on_bytes))

    async def get_upload(self, upload_id: str) -> UploadView:
        """Return how much of an upload the server holds, and its sha256 once it is whole."""
        return await self._run(calls.get_upload(upload_id))

    async def create_job(self, spec: JobSpec, *, idempotency_key: str) -> JobView:
        """Make a job from a finished upload. The same key with the same body gives the same job."""
        return await self._run(calls.create_job(spec, idempotency_key))

    async def submit(
        self,
        scan: Path,
        options: JobOptions | None = None,
        *,
        label: str = "",
        batch: str | None = None,
        priority: int = 0,
        retention_seconds: int | None = None,
        deadline: datetime | None = None,
        new: bool = False,
        on_bytes: OnBytes | None = None,
    ) -> JobView:
        """Check, pack and send a scan; the same scan, options, label and batch give the same job again.

        The server checks it once more before it queues the job: `watch_job` and `wait_for_job` tell what came of it.

        Raises ScanRejectedError, with every problem found, before anything is sent. `new` makes another job.
        `retention_seconds`: how long it is kept after its end. `deadline`: by when it is to end, with a time zone.
        """
        spec = job_spec(options, label, batch, priority, retention_seconds, deadline)
        await run_sync(ensure_submittable, scan, spec.options)
        with ExitStack() as stack:
            archive = await run_sync(stack.enter_context, packed(scan))
            together = () if batch is None else (f"batch {batch}",)
            memory = SubmissionMemory(self.config.url, archive.sha256, spec.options.model_dump_json(), label, *together)
            return await self._submit(memory, archive, spec, new, on_bytes)

    async def submit_remembered(self, memory: SubmissionMemory, scan: Path, spec: JobSpec) -> JobView:
        """Like `submit`, but what is the same submission is said by `memory`, so that a job that was made before is
        found without packing the scan again."""
        if (job_id := memory.load().job_id) is not None:
            with suppress(NotFoundError):
                return await self.get_job(job_id)
        await run_sync(ensure_submittable, scan, spec.options)
        with ExitStack() as stack:
            archive = await run_sync(stack.enter_context, packed(scan))
            return await self._submit(memory, archive, spec, False, None)

    async def _submit(
        self, memory: SubmissionMemory, archive: PackedScan, spec: JobSpec, new: bool, on_bytes: OnBytes | None
    ) -> JobView:
        with ExitStack() as stack:
            await run_sync(stack.enter_context, memory.alone())
            await run_sync(stack.enter_context, upload_alone(self.config.url, archive.sha256))
            return await self._drive(
                submission(memory, archive, spec, retries=self._retries, new=new, on_bytes=on_bytes)
            )

    async def _drive(self, steps: Generator[Step, Any, T]) -> T:
        try:
            step = next(steps)
            while True:
                if isinstance(step, calls.Pause):
                    await anyio.sleep(step.seconds)
                    step = next(steps)
                    continue
                try:
                    answer = await self._run(step)
                except ClientError as error:
                    step = steps.throw(error)
                else:
                    step = steps.send(answer)
        except StopIteration as end:
            result: T = end.value
            return result

    async def get_job(self, job_id: str) -> JobView:
        """Return a job as it is now. Raises NotFoundError if this key may see none of this id."""
        return await self._run(calls.get_job(job_id))

    async def list_jobs(
        self, *, state: JobState | None = None, label: str | None = None, batch: str | None = None, page: int = 100
    ) -> AsyncIterator[JobView]:
        """Yield all jobs, newest first, fetched page by page."""
        cursor = None
        while True:
            answer = await self._run(calls.list_jobs(state, label, batch, page, cursor))
            for job in answer.jobs:
                yield job
            if (cursor := answer.next_cursor) is None:
                return

    async def get_batch(self, batch_id: str) -> BatchView:
        """Return how the jobs of a batch stand, and how long the rest takes."""
        return await self._run(calls.get_batch(batch_id))

    async def list_batches(self, *, page: int = 100) -> AsyncIterator[BatchView]:
        """Yield all batches, newest first, fetched page by page."""
        cursor = None
        while True:
            answer = await self._run(calls.list_batches(page, cursor))
            for batch in answer.batches:
                yield batch
            if (cursor := answer.next_cursor) is None:
                return

    async def cancel_batch(self, batch_id: str) -> BatchView:
        """Cancel every job of a batch that has not ended."""
        return await self._run(calls.cancel_batch(batch_id))

    async def pause_batch(self, batch_id: str) -> BatchView:
        """Keep every job of a batch that waits waiting; what runs goes on."""
        return await self._run(calls.pause_batch(batch_id, True))

    async def resume_batch(self, batch_id: str) -> BatchView:
        """Let the jobs of a paused batch begin again."""
        return await self._run(calls.pause_batch(batch_id, False))

    async def limit_batch(self, batch_id: str, max_running: int | None) -> None:
        """Say how many jobs of a batch run at a time, also before its first one is made; None for any number."""
        await self._run(calls.limit_batch(batch_id, BatchLimits(max_running=max_running)))

    async def retry_batch(self, batch_id: str) -> BatchView:
        """Queue every failed job of a batch again; each goes on from its newest checkpoint."""
        return await self._run(calls.retry_batch(batch_id))

    async def cancel_job(self, job_id: str) -> JobView:
        """Stop a job; a running one writes a checkpoint first."""
        return await self._run(calls.cancel_job(job_id))

    async def retry_job(self, job_id: str) -> JobView:
        """Queue a failed or canceled job again; it goes on from its newest checkpoint."""
        return await self._run(calls.retry_job(job_id))

    async def delete_job(self, job_id: str) -> None:
        """Delete an ended job and its results on the server. Raises ConflictError while it has not ended."""
        await self._run(calls.delete_job(job_id))

    async def watch_job(
        self, job_id: str, *, timeout: float | None = None, on_trouble: OnTrouble | None = None
    ) -> AsyncIterator[JobView]:
        """Yield every change of a job until it ends, the last one included: by server-sent events, or else by polling.

        Trouble on the line is reported to `on_trouble` and outlived. Raises WaitTimeoutError after `timeout` seconds.
        """
        watch = Watch(job_id, timeout, on_trouble)
        while True:
            try:
                job = await self._run(calls.get_job(job_id), retries=0)
                if watch.is_news(job):
                    yield job
                if watch.done:
                    return
                async for news in self._events(watch):
                    yield news
            except ClientError as error:
                watch.trouble(error)
            if watch.done:
                return
            await anyio.sleep(watch.pause())

    async def wait_for_job(self, job_id: str, *, timeout: float | None = None) -> JobView:
        """Return the finished job. Raises JobFailedError or ScanRejectedError when it did not succeed."""
        last = None
        async for job in self.watch_job(job_id, timeout=timeout):
            last = job
        assert last is not None
        return calls.ensure_succeeded(last)

    async def download_results(
        self,
        job: JobView,
        folder: Path,
        *,
        names: Sequence[str] | None = None,
        on_bytes: OnFileBytes | None = None,
    ) -> list[Path]:
        """Fetch a job's results below `folder`; what is there already and whole is kept, parts are continued."""
        files = calls.chosen_results(job, names)
        targets = [target_path(folder, file.name) for file in files]  # a bad name stops it before the first byte
        return [await self._download(file, target, on_bytes) for file, target in zip(files, targets, strict=True)]

    async def _download(self, file: ResultFile, target: Path, on_bytes: OnFileBytes | None) -> Path:
        if await run_sync(is_there, target, file):
            return target
        attempts = calls.Attempts(True, self._retries)
        while True:
            with Download(target, file) as download:
                try:
                    await run_sync(download.load)
                    if not download.complete:
                        await self._fetch(file, download, on_bytes)
                    return await run_sync(download.finish)
                except (httpx.TransportError, ClientError) as error:
                    delay = attempts.after_error(error)
            await anyio.sleep(delay)

    async def _fetch(self, file: ResultFile, download: Download, on_bytes: OnFileBytes | None) -> None:
        url = result_url(self.config.url, file)
        async with self._http.stream("GET", url, headers=download.headers()) as response:
            if not response.is_success:
                await response.aread()
            download.begin(response)
            async for chunk in response.aiter_bytes():
                download.write(chunk)
                if on_bytes:
                    on_bytes(file, download.done)

    async def _events(self, watch: Watch) -> AsyncIterator[JobView]:
        """Yield news from the event stream, until it ends in whatever way."""
        path = calls.events_path(watch.job_id)
        try:
            async with self._http.stream(
                "GET", path, headers=watch.stream_headers(), timeout=watch.stream_timeout()
            ) as answer:
                if not is_event_stream(answer):
                    return
                async for line in answer.aiter_lines():
                    job = watch.view_from_line(line)
                    if job is not None:
                        yield job
                    if watch.done or watch.expired:
                        return
        except httpx.TransportError:
            return  # the next poll tells whether the server is there

    async def _run(self, call: calls.Call[T], retries: int | None = None) -> T:
        attempts = calls.Attempts(call.idempotent, self._retries if retries is None else retries)
        while True:
            delay: float | None
            try:
                response = await self._http.send(build(self._http, call))
            except httpx.TransportError as error:
                delay = attempts.after_error(error)
            else:
                delay = attempts.after_response(response)
                if delay is None:
                    return call.parse(response)
            await anyio.sleep(delay)
