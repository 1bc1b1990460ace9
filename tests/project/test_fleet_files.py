"""The table of docker/README.md: every file of a fleet is in it, with tests that there are and what they look at."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
import yaml
from kubernetes_objects import KUSTOMIZATION, objects, scaled_jobs

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "docker"
PAGE = (FOLDER / "README.md").read_text(encoding="utf-8")
ROWS = {row[0]: row[1:] for row in re.findall(r"^\| `([^`]+)` \| (.*) \| `([^`]+)` \| (.*) \|$", PAGE, re.MULTILINE)}


def text_of(name: str) -> str:
    return (FOLDER / name).read_text(encoding="utf-8")


def counts() -> dict[str, str]:
    """What the last column says, by the first."""
    rules = yaml.safe_load(text_of("prometheus/advtex.rules.yml"))
    panels = json.loads(text_of("grafana/advtex.json"))["panels"]
    expressions = sum(len(panel.get("targets", ())) for panel in panels)
    drawn = sum(panel["type"] != "row" for panel in panels)
    scraped = yaml.safe_load(text_of("prometheus/prometheus.yml"))["scrape_configs"]
    compose = yaml.safe_load((ROOT / "compose.yaml").read_text(encoding="utf-8"))
    unit = re.findall(r"^\w+=", text_of("systemd/advtex-worker.service"), re.MULTILINE)
    (budget,) = re.findall(r"^BUDGET = (\d+)e6$", (ROOT / "tests/project/test_image_size.py").read_text(), re.MULTILINE)
    return {
        "kubernetes": f"{len(objects())} objects in {len(KUSTOMIZATION['resources'])} files",
        "kubernetes/workers.yaml": f"{len(scaled_jobs())} classes of workers",
        "prometheus/advtex.rules.yml": f"{sum(len(group['rules']) for group in rules['groups'])} alerts",
        "prometheus/prometheus.yml": f"scrape_configs: {len(scraped)}",
        "grafana/advtex.json": f"{drawn} panels, {expressions} expressions",
        "slurm/advtex.sbatch": f"{len(re.findall('^#SBATCH', text_of('slurm/advtex.sbatch'), re.M))} options of sbatch",
        "systemd/advtex-worker.service": f"{len(unit)} settings",
        "server.Dockerfile": f"below {budget} MB",
        "worker.Dockerfile": f"{len(re.findall('^FROM', text_of('worker.Dockerfile'), re.M))} stages",
        "compose.yaml": f"{len(compose['services'])} services",
    }


def test_every_file_of_a_fleet_is_in_the_table() -> None:
    files = {path.relative_to(FOLDER).as_posix() for path in FOLDER.rglob("*") if path.is_file()} - {"README.md"}
    missing = {file for file in files if not any(file == row or file.startswith(f"{row}/") for row in ROWS)}
    assert not missing
    assert all((base / row).exists() for row in ROWS for base in [ROOT if row == "compose.yaml" else FOLDER])


@pytest.mark.parametrize("row", ROWS)
def test_a_row_names_tests_of_it(row: str) -> None:
    """The file of tests is there, and names what it checks by its name or through a helper of tests/support."""
    _how, tests, _result = ROWS[row]
    text = (ROOT / tests).read_text(encoding="utf-8")
    name = Path(row).name
    helpers = {"kubernetes": "kubernetes_objects", "workers.yaml": "kubernetes_objects"}
    assert any(word in text for word in (name, helpers.get(name, name), f"*{Path(row).suffix}"))


def test_the_last_column_says_what_there_is() -> None:
    assert {row: result for row, (_, _, result) in ROWS.items()} == counts()
