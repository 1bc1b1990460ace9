"""The API's description: kept in the repository, and true."""

from __future__ import annotations

import json
import os
import secrets
import time
from pathlib import Path
from typing import Any

import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
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
ANY = list(HealthCheck)
pytestmark = pytest.mark.one_machine("minutes long; odd characters meet PostgreSQL in test_health_and_errors.py")


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
            assert len(operation["tags"]) == 1, (method, path, "is shown once for each")
            for status, answer in operation["responses"].items():
                assert status.isdigit(), (method, path, status)
                if int(status) >= 400 and path != "/readyz":
                    schema = answer["content"]["application/json"]["schema"]
                    assert schema["$ref"].endswith("/ErrorBody"), (method, path, status)
            missing = {"401", "403", "429", "500", "503"} - set(operation["responses"])
            assert not (missing and path.startswith("/v1/")), (method, path, missing)
            assert ("security" in operation) == path.startswith("/v1/"), (method, path)


@schemathesis.serializer("application/zip", "application/offset+octet-stream")
def as_it_is(_context: Any, value: Any) -> Any:
    """Bytes of an upload."""
    return value.data if hasattr(value, "data") else value


schema = schemathesis.openapi.from_dict(described())
CHECKS = [not_a_server_error, status_code_conformance, content_type_conformance, response_schema_conformance]


@pytest.mark.slow
@schema.parametrize()
@settings(max_examples=12, deadline=None, phases=[Phase.explicit, Phase.generate], suppress_health_check=ANY)
def test_the_description_is_true(case: Any, live: Any) -> None:
    """Whatever the description allows, and some of what it does not: never a server error, always what is described."""
    response = case.call(base_url=live.url, headers={"Authorization": f"Bearer {live.key}"}, timeout=20)
    case.validate_response(response, checks=CHECKS)


@pytest.mark.slow
def test_sequences_of_calls_keep_to_the_description(live: Any) -> None:
    """What one call made is used, changed and removed by the next ones, in any order."""
    operations = [found.ok() for found in schema.get_all_operations()]
    worked: set[str] = set()

    # schemathesis's own state machine follows links by true randomness: whole runs of it never read a job
    @settings(max_examples=40, deadline=None, derandomize=True, phases=[Phase.generate], suppress_health_check=ANY)
    @given(st.lists(st.sampled_from(operations), min_size=8, max_size=14), st.data())
    def run(sequence: list[Any], data: Any) -> None:
        """Each sequence is a tenant of its own, who has one of each to begin with."""
        key = live.store.accounts.create_key("test", owner=secrets.token_hex(4))
        newest = {"batch_id": "b"}
        with live.client(key) as http:
            newest["upload_id"] = http.post("/v1/uploads", content=b"no zip").json()["id"]
            newest["job_id"] = http.post("/v1/jobs", json={"upload_id": newest["upload_id"], "batch": "b"}).json()["id"]
            while http.get(f"/v1/jobs/{newest['job_id']}").json()["state"] == "checking":
                time.sleep(0.02)
        for operation in sequence:
            case = data.draw(operation.as_strategy())
            # single calls meet every odd value in the other test; here they meet what is there, or was
            case.path_parameters.update({k: v for k, v in newest.items() if k in case.path_parameters})
            if operation.label == "POST /v1/jobs":
                case.body = {"upload_id": newest["upload_id"], "batch": "b"}
            headers = {"Authorization": f"Bearer {key}"}
            if case.headers and "tus-resumable" in case.headers:
                headers["Tus-Resumable"] = "1.0.0"  # any other version is refused, and nothing would follow
            response = case.call(base_url=live.url, headers=headers, timeout=20)
            case.validate_response(response, checks=CHECKS)
            if response.status_code < 300:
                worked.add(operation.label)
            if response.status_code == 201:
                newest[f"{operation.label[9:-1]}_id"] = response.json()["id"]

    run()
    assert {"GET /v1/jobs/{job_id}", "DELETE /v1/jobs/{job_id}", "GET /v1/batches/{batch_id}"} <= worked
