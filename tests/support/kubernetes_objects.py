"""What `docker/kubernetes` says."""

from __future__ import annotations

import functools
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

FOLDER = Path(__file__).parents[2] / "docker" / "kubernetes"
KUSTOMIZATION: dict[str, Any] = yaml.safe_load((FOLDER / "kustomization.yaml").read_text())
_COUNTED = r'\(sum\(max by \((\w+)\) \((\w+)\{(\w+)=~"([^"]+)"\}\)\) or vector\(0\)\)'


@functools.cache
def objects() -> list[dict[str, Any]]:
    """All of them, as they are written: what `kubectl kustomize` adds are a namespace and the tags of images."""
    files = [FOLDER / name for name in KUSTOMIZATION["resources"]]
    return [found for file in files for found in yaml.safe_load_all(file.read_text())]


def scaled_jobs() -> list[dict[str, Any]]:
    """The workers of each class."""
    return [found for found in objects() if found["kind"] == "ScaledJob"]


def pod_templates() -> Iterator[tuple[str, dict[str, Any]]]:
    """(component, template) of everything that makes pods."""
    for found in objects():
        spec = found.get("spec", {})
        template = spec.get("jobTargetRef", spec).get("template")
        if template is not None:
            yield template["metadata"]["labels"]["app.kubernetes.io/component"], template


def counted(scaled_job: dict[str, Any]) -> list[tuple[str, str, re.Pattern[str]]]:
    """What the query of its trigger adds up: (metric, label, values of the label that count). Several servers tell the
    same; of those one counts."""
    (trigger,) = scaled_job["spec"]["triggers"]
    terms = trigger["metadata"]["query"].split(" + ")
    found = [re.fullmatch(_COUNTED, term) for term in terms]
    assert all(term is not None and term[1] == term[3] for term in found), trigger["metadata"]["query"]
    return [(term[2], term[1], re.compile(term[4])) for term in found if term is not None]
