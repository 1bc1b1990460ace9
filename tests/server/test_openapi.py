"""The API's description: kept in the repository, and true."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, settings
from hypothesis.stateful import run_state_machine_as_test
from openapi_spec_validator import validate
from schemathesis.checks import not_a_server_error
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_schema_conformance,
    status_code_conformance,
)

from advtex_server.app import create_app
from advtex_server.settings import ServerSettings

KEPT = Path(__file__).parent / "openapi.json"


def described() -> dict[str, Any]:
    description = create_app(ServerSettings()).openapi()
    description["info"]["version"] = "0"
    return description


def test_the_kept_description_is_the_current_one() -> None:
    """After a wanted change: ADVTEX_WRITE_OPENAPI=1 pytest tests/server/test_openapi.py"""
    text = json.dumps(described(), indent=1, sort_keys=True) + "\n"
    if os.environ.get("ADVTEX_WRITE_OPENAPI"):
        KEPT.write_text(text)
    assert text == KEPT.read_text(), "the API has changed; is that wanted?"


def test_the_description_is_valid_and_every_call_is_described() -> None:
    description = described()
    validate(description)
    for path, methods in description["paths"].items():
        for method, operation in methods.items():
            assert operation["summary"], (method, path)
            assert "4XX" in operation["responses"]
            assert "422" not in operation["responses"], "validation errors have the one body too"
            assert ("security" in operation) == path.startswith("/v1/"), (method, path)


@schemathesis.serializer("application/zip", "application/offset+octet-stream")
def as_it_is(_context: Any, value: Any) -> Any:
    """Bytes of an upload."""
    return value.data if hasattr(value, "data") else value


schema = schemathesis.openapi.from_dict(described())
CHECKS = [not_a_server_error, status_code_conformance, content_type_conformance, response_schema_conformance]


@pytest.mark.slow
@schema.parametrize()
@settings(
    max_examples=12, deadline=None, phases=[Phase.explicit, Phase.generate], suppress_health_check=list(HealthCheck)
)
def test_the_description_is_true(case: Any, live: Any) -> None:
    """Whatever the description allows, and some of what it does not: never a server error, always what is described."""
    response = case.call(base_url=live.url, headers={"Authorization": f"Bearer {live.key}"}, timeout=20)
    case.validate_response(response, checks=CHECKS)


@pytest.mark.slow
def test_sequences_of_calls_keep_to_the_description(live: Any) -> None:
    """What one call made is used, changed and removed by the next ones, in any order."""
    seen: list[tuple[str, int]] = []

    class Calls(schema.as_state_machine()):  # type: ignore[misc]
        def before_call(self, case: Any) -> None:
            """Single calls meet every odd value in the other test; here they have to lead somewhere."""
            where = case.operation.label
            if where == "POST /v1/uploads" and len(seen) % 2:
                case.body, case.headers = b"no zip", {}
            elif where == "POST /v1/jobs" and isinstance(case.body, dict) and case.body.get("upload_id"):
                case.body = {"upload_id": case.body["upload_id"], "batch": "b"}

        def get_call_kwargs(self, case: Any) -> dict[str, Any]:
            headers = {"Authorization": f"Bearer {live.key}"}
            if case.headers and "tus-resumable" in case.headers:
                headers["Tus-Resumable"] = "1.0.0"  # any other version is refused, and nothing would follow
            return {"base_url": live.url, "headers": headers, "timeout": 20}

        def validate_response(self, response: Any, case: Any, **_: Any) -> None:
            seen.append((case.operation.label, response.status_code))
            case.validate_response(response, checks=CHECKS)

    run_state_machine_as_test(
        Calls,
        settings=settings(
            max_examples=15,
            stateful_step_count=10,
            deadline=None,
            phases=[Phase.explicit, Phase.generate],
            suppress_health_check=list(HealthCheck),
        ),
    )
    worked = {label for label, status in seen if status < 300}
    assert {"POST /v1/uploads", "POST /v1/jobs"} <= worked, "no sequence got beyond an upload"
