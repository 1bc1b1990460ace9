"""PostgreSQL, Redis, S3 and three workers: a batch by reference finishes, although worker after worker is killed."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import boto3
import pytest
from chaos import check_outcome, insist
from live_fleet import Fleet, Place, fleet, kill_tree
from live_service import process_tree, wait_until
from tiny_scan import write_zip

from advtex_store.models import JobRow
from advtex_store.records import POISON_DEATHS

SCENES = 16
STEPS = 40


def write_manifest(folder: Path, bucket: str, scan: Path) -> Path:
    """The same scan as many scenes: half of them files beside the manifest, half of them objects."""
    folder.mkdir()
    name, prefix = bucket.removeprefix("s3://").split("/")
    objects = boto3.client("s3", endpoint_url=os.environ["AWS_ENDPOINT_URL"])
    data = write_zip(folder / "scene.zip", scan).read_bytes()
    rows = []
    for number in range(SCENES):
        path = f"scene-{number:02}.zip"
        if number % 2:
            objects.put_object(Bucket=name, Key=f"{prefix}/{path}", Body=data)
            path = f"{bucket}/{path}"
        else:
            (folder / path).write_bytes(data)
        seed = 20 * number  # none of those that the engine treats in a way of their own
        rows.append({"path": path, "options": {"seed": seed, "steps": STEPS}})
    manifest = folder / "night.jsonl"
    manifest.write_text("\n".join(map(json.dumps, rows)))
    return manifest


def submit(manifest: Path, url: str, key: str, home: Path) -> None:
    """As a user does, who has sent nothing when it is done."""
    command = [sys.executable, "-m", "advtex_client.cli", "batch", "submit", str(manifest), "--by-reference"]
    environment = {**os.environ, "HOME": str(home), "XDG_STATE_HOME": str(home), "XDG_CONFIG_HOME": str(home)}
    environment |= {"ADVTEX_URL": url, "ADVTEX_API_KEY": key}
    done = subprocess.run([*command, "--id", "night"], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def one_at_work(running: Fleet, after: int) -> int | None:
    """The number of a worker that has a runner, another one each time where there are several; None if no job is left.

    Three deaths in a row without progress are poison, and a kill may come before the first step: a job that has died
    twice is left in peace.
    """
    found: list[int] = []

    def look() -> bool:
        with running.store.database.read() as session:
            at_work = session.query(JobRow).filter(JobRow.state == "running", JobRow.deaths < POISON_DEATHS - 1)
            horses = {int(str(row.worker).rpartition("-")[2]) for row in at_work}
        order = ((after + n) % len(running.workers) for n in range(len(running.workers)))
        trees = ((n, process_tree(running.workers[n].pid)) for n in order)
        found.extend(n for n, tree in trees if len(tree) > 2 and horses & set(tree))  # itself, RQ's horse, runner
        return bool(found) or running.store.records.count_by_state().get("succeeded", 0) == SCENES

    wait_until(look, seconds=60)
    return found[0] if found else None


@pytest.mark.slow
def test_a_batch_finishes_while_its_workers_are_killed(
    tmp_path: Path, scan: Path, postgres_url: str, s3_url: str
) -> None:
    bucket = "s3://" + s3_url.split("/")[2]
    manifest = write_manifest(tmp_path / "scenes", f"{bucket}/scans", scan)
    s3 = {name: value for name, value in os.environ.items() if name.startswith("AWS_")}
    place = Place(tmp_path / "data", postgres_url, s3_url, s3)
    roots = {"ADVTEX_REFERENCE_ROOTS": f"{manifest.parent.as_uri()} {bucket}/scans"}
    with fleet(tmp_path, place, workers=3, engine="journaled", variables=roots) as running:
        key = running.store.accounts.create_key("fleet", owner="fleet")
        submit(manifest, running.urls[0], key, tmp_path / "home")
        with running.store.database.read() as session:
            rows = list(session.query(JobRow))
        assert sum(row.source.startswith("s3://") for row in rows) == SCENES // 2
        jobs = {row.id: ("fleet", row.options["seed"], STEPS) for row in rows}

        def succeeded() -> int:
            return running.store.records.count_by_state().get("succeeded", 0)

        for goal in range(3, SCENES, 4):
            wait_until(lambda: succeeded() >= goal, seconds=120)  # noqa: B023
            victim = one_at_work(running, after=goal)
            if victim is None:  # a fast machine
                break
            kill_tree(running.workers[victim].pid)
            running.workers[victim].wait()
            running.workers[victim] = running.start_worker(victim)
        wait_until(lambda: succeeded() == SCENES, seconds=180)
        assert check_outcome(running, jobs, set()) == {"succeeded": SCENES}
        batch = insist(running, key, "GET", "/v1/batches/night").json()
        assert (batch["states"]["succeeded"], batch["finished"]) == (SCENES, True)
        assert sum(running.store.records.job(job).attempt for job in jobs) > SCENES, "no kill hit a running job"
