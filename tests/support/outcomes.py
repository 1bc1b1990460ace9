"""What must hold of a job of the engine `stepping` once it is done, whatever happened meanwhile."""

from __future__ import annotations

import json

import fake_engines
from live_service import LiveService

from advtex_client import Client
from advtex_contract.jobs import JobView


def assert_done_once(service: LiveService, client: Client, job_id: str, steps: int) -> dict[str, list[int]]:
    """Every step counts once in the result, and there is one manifest. -> the engine's own account."""
    job: JobView = client.wait_for_job(job_id, timeout=60)
    (result,) = [file for file in job.results if file.name == "model.obj"]
    manifest = service.store.results.manifest(job_id)
    text = b"".join(
        chunk for file in manifest.files if file.name == "model.obj" for chunk in service.store.blobs.stream(file.key)
    )
    assert len(text) == result.size
    state = json.loads(text.decode().split("\n", 1)[1])
    assert state["step"] == steps
    assert state["chain"] == fake_engines.chain(steps)
    assert {file.key.split("/")[3] for file in manifest.files} == {str(manifest.attempt)}
    return state
