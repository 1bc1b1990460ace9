"""PostgreSQL, Redis, S3 and three workers: a batch by reference finishes, although worker after worker is killed."""

from __future__ import annotations

import itertools
import os
from pathlib import Path

import pytest
from chaos import check_outcome, insist
from fleet import Place, fleet, kill_tree
from live_service import wait_until
from tiny_scan import write_zip

SCENES = 30
STEPS = 40


@pytest.mark.slow
def test_a_batch_finishes_while_its_workers_are_killed(
    tmp_path: Path, scan: Path, postgres_url: str, s3_url: str
) -> None:
    scenes = tmp_path / "scenes"
    scenes.mkdir()
    first = write_zip(scenes / "scene-00.zip", scan)
    for number in range(1, SCENES):
        (scenes / f"scene-{number:02}.zip").write_bytes(first.read_bytes())
    s3 = {name: value for name, value in os.environ.items() if name.startswith("AWS_")}
    place = Place(tmp_path / "data", postgres_url, s3_url, s3)
    roots = {"ADVTEX_REFERENCE_ROOTS": scenes.as_uri()}
    with fleet(tmp_path, place, workers=3, engine="journaled", variables=roots) as running:
        key = running.store.accounts.create_key("fleet", owner="fleet")
        jobs = {}
        for number, path in enumerate(sorted(scenes.iterdir())):
            seed = 20 * number  # none of those that the engine treats in a way of their own
            body = {"source": path.as_uri(), "batch": "night", "options": {"seed": seed, "steps": STEPS}}
            answer = insist(running, key, "POST", "/v1/jobs", json=body, headers={"Idempotency-Key": path.name})
            jobs[answer.json()["id"]] = ("fleet", seed, STEPS)

        def succeeded() -> int:
            return running.store.records.count_by_state().get("succeeded", 0)

        victims = itertools.cycle(range(3))
        for goal in range(3, SCENES, 4):
            wait_until(lambda: succeeded() >= goal, seconds=120)  # noqa: B023
            victim = next(victims)
            kill_tree(running.workers[victim].pid)
            running.workers[victim].wait()
            running.workers[victim] = running.start_worker(victim)
        wait_until(lambda: succeeded() == SCENES, seconds=180)
        assert check_outcome(running, jobs, set()) == {"succeeded": SCENES}
        batch = insist(running, key, "GET", "/v1/batches/night").json()
        assert (batch["states"]["succeeded"], batch["finished"]) == (SCENES, True)
        assert sum(running.store.records.job(job).attempt for job in jobs) > SCENES, "no kill hit a running job"
