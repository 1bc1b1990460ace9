"""What comes with the metrics: the alerts fire when they should, and rules and dashboard use what there is."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from prometheus_client.parser import text_string_to_metric_families

from advtex_contract.jobs import JobError, Progress
from advtex_store.fleet import GpuReading, WorkerReport

ROOT = Path(__file__).parents[2]
RULES = ROOT / "docker/prometheus/advtex.rules.yml"
STATES = Path(__file__).parent / "alerts.yml"
DASHBOARD = json.loads((ROOT / "docker/grafana/advtex.json").read_text())
NAME = re.compile(r"\badvtex_[a-z_]+")
WIDTH = 24  # columns of Grafana's grid


def alerts() -> list[dict[str, Any]]:
    return [rule for group in yaml.safe_load(RULES.read_text())["groups"] for rule in group["rules"]]


def targets() -> Iterator[tuple[str, str]]:
    """(title, expression) of every panel of the dashboard"""
    for panel in DASHBOARD["panels"]:
        for target in panel.get("targets", ()):
            yield panel["title"], target["expr"]


def promtool(*arguments: str) -> None:
    tool = shutil.which("promtool")
    if tool is None:
        pytest.skip("there is no promtool: apt-get install prometheus")
    ran = subprocess.run([tool, *arguments], capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stdout + ran.stderr


def test_every_alert_fires_in_its_recorded_state_and_none_in_a_healthy_one() -> None:
    promtool("test", "rules", str(STATES))


def test_every_alert_has_such_a_state_and_is_quiet_in_the_healthy_one() -> None:
    recorded = yaml.safe_load(STATES.read_text())["tests"]
    names = {rule["alert"] for rule in alerts()}
    assert {one["alertname"] for one in recorded[0]["alert_rule_test"]} == names
    assert not any(one.get("exp_alerts") for one in recorded[0]["alert_rule_test"])
    fires = {one["alertname"] for state in recorded[1:] for one in state["alert_rule_test"] if one.get("exp_alerts")}
    assert fires == names


def test_every_alert_says_what_to_do() -> None:
    headings = re.findall(r"^## (\w+)$", (ROOT / "server/RUNBOOK.md").read_text(), re.MULTILINE)
    assert headings == [rule["alert"] for rule in alerts()]
    for rule in alerts():
        assert rule["annotations"]["runbook"] == f"server/RUNBOOK.md#{rule['alert'].lower()}"
        assert rule["labels"]["severity"] in ("warning", "critical")
        assert rule["annotations"]["summary"]


def test_prometheus_accepts_the_example_and_the_expressions_of_the_dashboard(tmp_path: Path) -> None:
    shown = [expression.replace("$__rate_interval", "1m").replace("$instance", ".*") for _, expression in targets()]
    rules = [{"record": f"panel:{number}", "expr": expression} for number, expression in enumerate(shown)]
    (tmp_path / "panels.yml").write_text(yaml.safe_dump({"groups": [{"name": "panels", "rules": rules}]}))
    promtool("check", "rules", str(tmp_path / "panels.yml"))
    promtool("check", "config", str(ROOT / "docker/prometheus/prometheus.yml"))


def test_the_dashboard_is_one_that_grafana_can_draw() -> None:
    panels = DASHBOARD["panels"]
    assert {"title", "uid", "schemaVersion", "templating", "time"} <= set(DASHBOARD)
    assert len({panel["id"] for panel in panels}) == len(panels)
    taken = set[tuple[int, int]]()
    for panel in panels:
        place = panel["gridPos"]
        cells = {(place["x"] + x, place["y"] + y) for x in range(place["w"]) for y in range(place["h"])}
        assert max(x for x, _ in cells) < WIDTH
        assert not cells & taken, f"{panel['title']} lies on another panel"
        taken |= cells
        if panel["type"] != "row":
            assert panel["title"]
            assert panel["description"]
            assert len({target["refId"] for target in panel["targets"]}) == len(panel["targets"]) > 0
    variables = {variable["name"] for variable in DASHBOARD["templating"]["list"]}
    assert set(re.findall(r"\$\{?(\w+)", json.dumps(DASHBOARD))) - {"__rate_interval", "__all"} == variables


@pytest.mark.one_machine("tests/store has the same on both databases")
def test_rules_and_dashboard_use_metrics_and_labels_that_there_are(
    make_live: Any, redis_url: str, scan_zip: Path
) -> None:
    """Of a server that has seen a bit of everything."""
    live = make_live(redis_url=redis_url, metrics_key=True)
    reading = GpuReading(uuid="GPU-a", memory_used_bytes=1, memory_bytes=2, utilization=0.5)
    live.store.queue.announce("w", 12, busy=True)
    live.store.fleet.tell("w", WorkerReport(host="h", gpu=reading))
    upload = live.upload(scan_zip.read_bytes())
    failed, running, _waiting = (live.job(upload)["id"] for _ in range(3))
    for job in (failed, running):
        live.store.records.claim(job, 1, "w")
    live.store.records.heartbeat(failed, 1, Progress(stage="atlas", stage_seconds={"atlas": 1.0}))
    live.store.records.fail(failed, 1, JobError(code="engine_error", message="no"))
    with live.store.troubles.of("a task of no housekeeping", failed):
        raise ValueError("no")
    with live.client(live.store.accounts.create_key("prometheus", scopes=["admin"])) as prometheus:
        text = prometheus.get("/metrics").text
    labels = dict[str, set[str]]()
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            labels.setdefault(sample.name, {"instance"}).update(sample.labels)
    expressions = [*targets(), *((rule["alert"], rule["expr"]) for rule in alerts())]
    for state in yaml.safe_load(STATES.read_text())["tests"]:
        expressions += [(state["name"], one["series"]) for one in state["input_series"]]
    for where, expression in expressions:
        names = set(NAME.findall(expression))
        assert names
        assert names <= set(labels), where
        known = set.union(*(labels[name] for name in names))
        used = set(re.findall(r"(\w+)=", expression))
        for group in re.findall(r"by \(([\w, ]+)\)", expression):
            used |= set(group.split(", "))
        assert used <= known, where
