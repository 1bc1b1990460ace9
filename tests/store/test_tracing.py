"""Spans and what makes them one trace; and that nothing of it is there when nobody asks."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import pytest
from collector import collector
from opentelemetry.sdk.trace import TracerProvider
from opentelemetry.sdk.trace.export import SimpleSpanProcessor
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter
from opentelemetry.sdk.trace.sampling import ALWAYS_OFF

from advtex_store.tracing import OFF, PLACES, Traces, open_traces


@pytest.fixture(autouse=True)
def _no_variables(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in (*PLACES, "OTEL_TRACES_EXPORTER", "OTEL_SDK_DISABLED", "OTEL_SERVICE_NAME"):
        monkeypatch.delenv(name, raising=False)


@pytest.fixture
def memory() -> Iterator[tuple[Traces, InMemorySpanExporter]]:
    exporter = InMemorySpanExporter()
    provider = TracerProvider(shutdown_on_exit=False)
    provider.add_span_processor(SimpleSpanProcessor(exporter))
    traces = Traces(provider)
    yield traces, exporter
    traces.close()


def test_a_child_elsewhere_is_of_the_same_trace(memory: Any) -> None:
    traces, exporter = memory
    root = traces.span("submit", None, owner="ada", batch=None)
    queue = traces.span("queue", root.traceparent, start=1000.5)
    queue.end()
    attempt = traces.span("attempt", root.traceparent)
    attempt.child("stage atlas", memory_bytes=7).end()
    attempt.end("it failed", state="failed")
    root.end(job="7")
    found = {span.name: span for span in exporter.get_finished_spans()}
    assert {span.context.trace_id for span in found.values()} == {found["submit"].context.trace_id}
    assert found["queue"].start_time == 1_000_500_000_000
    assert found["queue"].parent.span_id == found["attempt"].parent.span_id == found["submit"].context.span_id
    assert found["stage atlas"].parent.span_id == found["attempt"].context.span_id
    assert dict(found["submit"].attributes) == {"advtex.owner": "ada", "advtex.job": "7"}
    assert (found["attempt"].status.status_code.name, found["attempt"].status.description) == ("ERROR", "it failed")
    assert found["submit"].status.status_code.name == "UNSET"


@pytest.mark.parametrize("parent", ["", "nonsense", "00-0-0-01"])
def test_a_row_without_a_good_parent_begins_a_trace(memory: Any, parent: str) -> None:
    traces, exporter = memory
    traces.span("attempt", parent).end()
    (span,) = exporter.get_finished_spans()
    assert span.parent is None


def test_what_is_not_sampled_stays_so_in_its_children() -> None:
    exporter = InMemorySpanExporter()
    provider = TracerProvider(shutdown_on_exit=False)
    provider.add_span_processor(SimpleSpanProcessor(exporter))
    unsampled = Traces(TracerProvider(sampler=ALWAYS_OFF, shutdown_on_exit=False)).span("submit", None).traceparent
    assert unsampled is not None
    assert int(unsampled[-2:], 16) & 1 == 0
    Traces(provider).span("attempt", unsampled).end()
    assert exporter.get_finished_spans() == ()


@pytest.mark.parametrize(
    "variables",
    [
        {},
        {"OTEL_TRACES_EXPORTER": "none", PLACES[0]: "http://127.0.0.1:9"},
        {"OTEL_TRACES_EXPORTER": "console"},
        {"OTEL_SDK_DISABLED": "true", PLACES[0]: "http://127.0.0.1:9"},
    ],
)
def test_nothing_is_traced_unless_it_is_asked_for(monkeypatch: pytest.MonkeyPatch, variables: dict[str, str]) -> None:
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    traces = open_traces("test")
    assert not traces.on
    span = traces.span("submit", None, job="7")
    assert span.traceparent is None
    span.child("stage").end("error")
    span.end()
    traces.close()


def test_without_the_extra_it_is_said_once_and_nothing_breaks(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv(PLACES[0], "http://127.0.0.1:9")
    monkeypatch.setitem(sys.modules, "opentelemetry.exporter.otlp.proto.http.trace_exporter", None)
    assert open_traces("test") is OFF
    assert "advtex[traces]" in capsys.readouterr().out


def test_nothing_is_imported_where_nobody_asks() -> None:
    code = (  # Redis's client looks for OpenTelemetry too, so that it is not asked here
        "import sys; from advtex_store.tracing import open_traces; open_traces('x').span('y', None).end();"
        "print([name for name in sys.modules if 'opentelemetry' in name])"
    )
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert told.strip() == "[]"


def test_a_collector_gets_them_over_http_and_one_that_is_away_keeps_nobody(monkeypatch: pytest.MonkeyPatch) -> None:
    with collector() as found:
        monkeypatch.setenv("OTEL_EXPORTER_OTLP_TRACES_ENDPOINT", found.url + "/v1/traces")
        traces = open_traces("advtex-worker")
        assert traces.on
        traces.span("attempt", "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01", job="7").end()
        traces.close()
    (span,) = found.spans
    assert (span.service, span.name, span.parent) == ("advtex-worker", "attempt", "b7ad6b7169203331")
    assert span.trace == "0af7651916cd43dd8448eb211c80319c"
    assert span.attributes == {"advtex.job": "7"}
    monkeypatch.setattr("advtex_store.tracing.FLUSH_SECONDS", 0.05)
    away = open_traces("advtex-worker")
    away.span("attempt", None).end()
    away.close()
