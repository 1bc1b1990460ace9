"""The trace of a job, as a collector gets it from a server and from workers one of which is killed."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from advtex_contract.jobs import JobState
from advtex_contract.options import JobOptions
from advtex_store import keys

if TYPE_CHECKING:
    from collector import Collector
    from live_service import LiveService

pytestmark = pytest.mark.slow


@pytest.fixture
def traced(tmp_path: Path) -> Iterator[tuple[LiveService, Collector]]:
    from collector import collector
    from live_service import live_service

    with collector() as found:
        variables = {
            "OTEL_EXPORTER_OTLP_ENDPOINT": found.url,
            "OTEL_BSP_SCHEDULE_DELAY": "100",
            "ADVTEX_WEBHOOK_ALLOW_HTTP": "true",
            "ADVTEX_WEBHOOK_NETWORKS": '["127.0.0.0/8"]',
        }
        with live_service(tmp_path / "service", settings=variables) as service:
            yield service, found


def test_one_trace_from_the_upload_to_the_webhook_through_an_attempt_that_is_killed(
    traced: tuple[LiveService, Collector], scan: Path
) -> None:
    from live_service import process_tree, wait_until

    service, collector = traced
    worker = service.start_worker("stepping")
    with service.client() as client:
        service.store.webhooks.create("tests", f"{collector.url}/hook", [JobState.succeeded])
        job = client.submit(scan, JobOptions(steps=80))
        index = keys.checkpoint_prefix(job.id, 1) + "index.json"
        wait_until(lambda: service.store.blobs.exists(index) and collector.named("queue"), seconds=60)
        for pid in process_tree(worker.pid):
            os.kill(pid, signal.SIGKILL)
        service.start_worker("stepping")
        assert client.wait_for_job(job.id, timeout=90).attempt == 2
    wait_until(lambda: collector.named("attempt") and collector.named("webhook"), seconds=60)
    (upload,), (submit,), (check,) = (collector.named(name) for name in ("upload", "submit", "check"))
    (attempt,), (lost,), (webhook,) = (collector.named(name) for name in ("attempt", "lost", "webhook"))
    assert {span.trace for span in collector.spans} == {upload.trace}
    assert upload.parent == ""
    assert submit.parent == upload.span
    queues = collector.named("queue")
    assert [span.attributes["advtex.attempt"] for span in queues] == [1, 2]
    assert {span.parent for span in (check, *queues, attempt, lost, webhook)} == {submit.span}
    assert {span.service for span in (upload, submit, check, lost, webhook)} == {"advtex-server"}
    assert {span.service for span in (attempt, *queues)} == {"advtex-worker"}
    assert lost.failed
    assert lost.attributes["advtex.attempt"] == 1
    assert not attempt.failed
    assert attempt.attributes["advtex.state"] == "succeeded"
    stages = collector.named("stage optimization")
    assert [span.parent for span in stages] == [attempt.span]
    (posted,) = collector.others
    assert posted["traceparent"] == f"00-{webhook.trace}-{webhook.span}-{posted['traceparent'][-2:]}"
    order = [upload.start, submit.start, queues[0].start, queues[0].end, queues[1].start, attempt.start]
    assert order == sorted(order)
    assert attempt.start <= stages[0].start <= stages[0].end <= attempt.end
