"""One trace per job, through all servers and workers that have to do with it: by OpenTelemetry, where it is asked for.

The span in which a job is made is named by the `traceparent` of its row (W3C Trace Context), and so is the one of an
upload in its own; whatever happens to the job later, in whichever process, is a child of it. OpenTelemetry's own
variables say where spans go, and a process that is given none of them imports nothing.
"""

from __future__ import annotations

import os
import threading
from typing import TYPE_CHECKING, Any

import structlog

if TYPE_CHECKING:
    from opentelemetry.sdk.trace import TracerProvider
    from opentelemetry.trace import Span as OtelSpan

PLACES = ("OTEL_EXPORTER_OTLP_ENDPOINT", "OTEL_EXPORTER_OTLP_TRACES_ENDPOINT")
FLUSH_SECONDS = 3.0  # a process that ends waits no longer for a collector

log = structlog.get_logger("advtex.traces")


class Span:
    """Something that takes time. Where there are no traces, nothing is done with it, and its `traceparent` is None."""

    def __init__(self, traces: Traces, span: OtelSpan | None) -> None:
        self._traces = traces
        self._span = span

    @property
    def traceparent(self) -> str | None:
        """What makes others its children."""
        if self._span is None:
            return None
        context = self._span.get_span_context()
        return f"00-{context.trace_id:032x}-{context.span_id:016x}-{context.trace_flags:02x}"

    def child(self, name: str, *, start: float | None = None, **attributes: Any) -> Span:
        return self._traces.span(name, self.traceparent, start=start, **attributes)

    def end(self, error: str = "", **attributes: Any) -> None:
        """Now. error: why it failed, if it did."""
        if self._span is None:
            return
        from opentelemetry.trace import Status, StatusCode

        self._span.set_attributes(_named(attributes))
        if error:
            self._span.set_status(Status(StatusCode.ERROR, error))
        self._span.end()


class Traces:
    """Spans of one process, sent to nobody without a provider."""

    def __init__(self, provider: TracerProvider | None = None) -> None:
        self._provider = provider
        self._tracer = None if provider is None else provider.get_tracer("advtex")

    @property
    def on(self) -> bool:
        return self._tracer is not None

    def span(self, name: str, parent: str | None, *, start: float | None = None, **attributes: Any) -> Span:
        """Begin a span, now or at a time since 1970. parent: a `traceparent`; None begins a trace of its own.

        attributes: of OpenTelemetry, those without a dot in their names as `advtex.name`; None is left out.
        """
        if self._tracer is None:
            return Span(self, None)
        from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

        context = TraceContextTextMapPropagator().extract({} if parent is None else {"traceparent": parent})
        began = None if start is None else int(start * 1e9)
        return Span(
            self, self._tracer.start_span(name, context=context, start_time=began, attributes=_named(attributes))
        )

    def close(self) -> None:
        """Send what is left. A collector that does not answer is not waited for."""
        if self._provider is not None:
            sending = threading.Thread(target=self._provider.shutdown, daemon=True)
            sending.start()
            sending.join(FLUSH_SECONDS)


OFF = Traces()


def open_traces(service: str) -> Traces:
    """As `OTEL_*` asks for it. service: the name of the process's kind, unless `OTEL_SERVICE_NAME` has one."""
    exporter = os.environ.get("OTEL_TRACES_EXPORTER", "")
    asked = exporter == "otlp" or (exporter == "" and any(os.environ.get(name) for name in PLACES))
    if not asked or os.environ.get("OTEL_SDK_DISABLED", "").lower() == "true":
        return OFF
    try:
        from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
        from opentelemetry.sdk.resources import SERVICE_NAME, Resource
        from opentelemetry.sdk.trace import TracerProvider
        from opentelemetry.sdk.trace.export import BatchSpanProcessor
    except ImportError as error:
        log.warning("no traces: OTEL_* asks for them, `pip install 'advtex[traces]'` brings them", missing=error.name)
        return OFF
    name = {} if os.environ.get("OTEL_SERVICE_NAME") else {SERVICE_NAME: service}
    provider = TracerProvider(resource=Resource.create(name), shutdown_on_exit=False)
    provider.add_span_processor(BatchSpanProcessor(OTLPSpanExporter()))
    return Traces(provider)


def _named(attributes: dict[str, Any]) -> dict[str, Any]:
    return {name if "." in name else f"advtex.{name}": value for name, value in attributes.items() if value is not None}
