"""The benchmark of the API runs, small, so that it is there when it is needed; its limits are for idle machines."""

from __future__ import annotations

import pytest
from load import P99_LIMITS_MS, Load, run, verdicts


@pytest.mark.slow
def test_a_small_load_is_measured() -> None:
    found = run(Load(pollers=5, streams=2, uploads=1, seconds=3.0, finished=200))
    assert found["get_job"]["count"] >= 5
    assert found["list_jobs"]["count"] == 4
    assert 0 < found["get_job"]["p50_ms"] <= found["get_job"]["p99_ms"]
    assert found["uploaded_mb_per_second"] > 0


def test_a_limit_holds_or_does_not() -> None:
    below = {name: {"p99_ms": limit - 0.1} for name, limit in P99_LIMITS_MS.items()}
    assert verdicts(below) == dict.fromkeys(P99_LIMITS_MS, True)
    assert verdicts(below | {"list_jobs": {"p99_ms": 50.0}}) == {"get_job": True, "list_jobs": False}
