"""The benchmark of the fleet runs, tiny, so that it is there when it is needed; its limits are for idle machines."""

from __future__ import annotations

from pathlib import Path

import fleet
import pytest
from harness import Results


@pytest.mark.slow
def test_a_tiny_fleet_is_measured(tmp_path: Path, postgres_server: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fleet, "BEATING_PROCESSES", 1)
    results = Results(tmp_path / "fleet.json")
    for database, server in (("sqlite", None), ("postgresql", postgres_server)):
        for jobs in (40, 80):
            fleet.run(fleet.Fleet(database, jobs, 2, seconds=0.5), False, results, server)
            fleet.run(fleet.Fleet(database, jobs, 2, seconds=0.5), True, results, server)
    page = fleet.report(results.cells)
    assert page.count("| postgresql |") == page.count("| sqlite |") == 4
    assert page.count("grows with jobs") == 4
    for cell in results.cells:
        zero = [name for name, value in cell["scores"].items() if value <= 0 and name != "commits_per_s"]
        assert zero == [], cell
    limited = {what for what, _, _ in fleet.verdicts(results.cells)}
    assert len(limited) == 7, "all four on PostgreSQL, and three of them on SQLite"


def test_growth_is_a_power_of_the_number_of_jobs() -> None:
    jobs = [1_000, 10_000, 100_000]
    assert fleet.exponent(jobs, [7.0, 7.0, 7.0]) == pytest.approx(0.0)
    assert fleet.exponent(jobs, [2.0, 20.0, 200.0]) == pytest.approx(1.0)
