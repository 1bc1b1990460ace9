"""Three servers behind one address, each with nothing but its own folder: every request may go to any of them."""

from __future__ import annotations

import itertools
import os
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import httpx
import pytest
from live_fleet import Place, fleet, is_up
from live_service import wait_until
from tiny_scan import write_zip

from advtex_client import Client
from advtex_contract.jobs import JobState

ADDRESS = "http://advtex.test"
TUS = {"Tus-Resumable": "1.0.0"}


class ByTurns(httpx.BaseTransport):
    """A balancer: each request goes to the next of the servers that take connections."""

    def __init__(self, urls: Sequence[str]) -> None:
        self._transport = httpx.HTTPTransport()
        self._urls = itertools.cycle(urls)
        self._servers = len(urls)
        self.answered = Counter[int]()

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        for _ in range(self._servers):
            url = httpx.URL(next(self._urls))
            there = httpx.Request(
                request.method,
                request.url.copy_with(host=url.host, port=url.port),
                headers=request.headers,
                stream=request.stream,
                extensions=request.extensions,
            )
            try:
                response = self._transport.handle_request(there)
            except httpx.ConnectError:
                continue
            assert url.port is not None
            self.answered[url.port] += 1
            return response
        raise httpx.ConnectError("no server takes connections")

    def close(self) -> None:
        self._transport.close()


def upload(http: httpx.Client, data: bytes) -> str:
    """In three pieces."""
    created = http.post("/v1/uploads", headers=TUS | {"Upload-Length": str(len(data))})
    assert created.status_code == 201, created.text
    location = httpx.URL(created.headers["Location"]).path
    third = len(data) // 3
    for begin, end in ((0, third), (third, 2 * third), (2 * third, len(data))):
        headers = {"Content-Type": "application/offset+octet-stream", "Upload-Offset": str(begin)}
        assert http.patch(location, content=data[begin:end], headers=TUS | headers).status_code == 204
        offsets = {http.head(location, headers=TUS).headers["Upload-Offset"] for _ in range(3)}
        assert offsets == {str(end)}
    return location.rpartition("/")[2]


@pytest.mark.slow
def test_every_request_may_go_to_another_server(tmp_path: Path, scan: Path, postgres_url: str, s3_url: str) -> None:
    s3 = {name: value for name, value in os.environ.items() if name.startswith("AWS_")}
    place = Place(tmp_path / "data", postgres_url, s3_url, s3)
    hurry = tmp_path / "hurry"
    patient = {"ADVTEX_LEASE_SECONDS": "20", "ADVTEX_ENGINE_HURRY": str(hurry)}
    with fleet(tmp_path, place, servers=3, workers=1, engine="leisurely", variables=patient, dispatch=False) as running:
        key = running.store.accounts.create_key("fleet", owner="fleet")
        turns = ByTurns(running.urls)
        headers = {"Authorization": f"Bearer {key}"}
        with (
            httpx.Client(base_url=ADDRESS, headers=headers, transport=turns, timeout=30) as http,
            Client(ADDRESS, key, transport=turns) as client,
        ):
            upload_id = upload(http, write_zip(tmp_path / "scan.zip", scan).read_bytes())
            body = {"upload_id": upload_id, "options": {"steps": 2500}}
            answers = [http.post("/v1/jobs", json=body, headers={"Idempotency-Key": "one"}) for _ in range(3)]
            (job_id,) = {str(answer.json()["id"]) for answer in answers}

            time.sleep(1)
            states = {http.get(f"/v1/jobs/{job_id}").json()["state"] for _ in range(3)}
            assert states == {"checking"}, "servers that do not dispatch do not check either"
            dispatcher = running.start_dispatcher()
            wait_until(lambda: client.get_job(job_id).state == JobState.running, 60)
            running.servers[0].kill()
            hurry.touch()
            job = client.wait_for_job(job_id, timeout=60)
            assert (job.state, job.attempt) == (JobState.succeeded, 1)

            running.servers[0].wait()
            running.servers[0] = running.start_server(0)
            wait_until(lambda: is_up(running.urls[0]), 60)
            file = f"/v1/jobs/{job_id}/results/model.obj"
            whole = [http.get(file) for _ in range(3)]
            assert len({(answer.headers["ETag"], answer.content) for answer in whole}) == 1
            half = len(whole[0].content) // 2
            ranges = (f"bytes=0-{half - 1}", f"bytes={half}-")
            parts = [http.get(file, headers={"Range": wanted}) for wanted in ranges]
            assert [part.status_code for part in parts] == [206, 206]
            assert b"".join(part.content for part in parts) == whole[0].content
            dispatcher.terminate()
            assert dispatcher.wait(30) == 0
        turns = ByTurns(running.urls)
        with httpx.Client(base_url=ADDRESS, transport=turns, timeout=30) as browser:
            browser.post("/sign-in", data={"key": key}, headers={"Origin": ADDRESS})
            assert {browser.get(f"/jobs/{job_id}").status_code for _ in range(3)} == {200}
            assert len(turns.answered) == 3
