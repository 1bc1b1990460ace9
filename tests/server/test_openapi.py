"""The API's description: kept in the repository, and true."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, settings
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


@schemathesis.serializer("application/zip")
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
