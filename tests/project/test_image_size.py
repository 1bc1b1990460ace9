"""The server's image stays under 250 MB: its base, and what constraints.txt has it install, counted as it lies here."""

from __future__ import annotations

import re
import tomllib
from importlib.metadata import Distribution, distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
DOCKERFILE, WORKER = (
    (ROOT / "docker" / name).read_text(encoding="utf-8") for name in ("server.Dockerfile", "worker.Dockerfile")
)
BUDGET = 250e6
BASE = 130e6  # of python:3.12-slim-bookworm, unpacked; rounded up
HEAVY = {"torch", "numpy", "opencv-python-headless", "av", "imagecodecs", "usd-core"}


def extras(dockerfile: str) -> str:
    """What it installs of the package: `server,traces`."""
    return str(re.findall(r"'\.\[([\w,]+)\]'", dockerfile)[0])


def closure(extras: str) -> dict[str, Distribution]:
    """What `pip install .[extras]` installs, but for the package itself."""
    found: dict[str, Distribution] = {}
    seen = set[tuple[str, str]]()

    def visit(line: str, asked: str) -> None:
        wanted = Requirement(line)
        if wanted.marker is not None and not wanted.marker.evaluate({"extra": asked}):
            return
        for inner in ("", *wanted.extras):
            if wanted.name == PROJECT["name"]:
                lines = PROJECT["optional-dependencies"].get(inner, [])
            elif (key := (canonicalize_name(wanted.name), inner)) not in seen:
                seen.add(key)
                found[key[0]] = distribution(wanted.name)
                lines = found[key[0]].requires or []
            else:
                continue
            for further in lines:
                visit(further, inner)

    for line in (*PROJECT["dependencies"], f"{PROJECT['name']}[{extras}]"):
        visit(line, "")
    return found


def size(dist: Distribution) -> int:
    """Bytes of its files, compiled ones included, without what the Dockerfile removes."""
    kept = re.findall(r"! -name ([\w-]+)", DOCKERFILE)
    files = [
        Path(str(file.locate()))
        for file in dist.files or []
        if file.parts[:2] != ("botocore", "data") or len(file.parts) == 3 or file.parts[2] in kept
    ]
    return sum(file.stat().st_size for file in files if file.is_file())


def test_the_servers_image_is_small() -> None:
    installed = closure(extras(DOCKERFILE))
    assert {"fastapi", "sqlalchemy", "psycopg-binary", "boto3", "httpx"} <= set(installed)
    assert not HEAVY & set(installed)
    own = sum(path.stat().st_size for path in ROOT.glob("[csw]*/advtex_*/**/*") if path.is_file())
    sizes = {name: size(dist) for name, dist in installed.items()} | {"advtex": own}
    largest = sorted(sizes.items(), key=lambda entry: -entry[1])[:8]
    assert BASE + sum(sizes.values()) < BUDGET, largest


def test_what_the_image_keeps_of_botocore_serves_object_storage() -> None:
    kept = re.findall(r"! -name ([\w-]+)", DOCKERFILE)
    services = {
        file.parts[2] for file in distribution("botocore").files or [] if file.parts[:2] == ("botocore", "data")
    }
    assert {"s3", "sts"} <= set(kept) <= services


def test_both_images_can_send_traces() -> None:
    for dockerfile in (DOCKERFILE, WORKER):
        assert {"opentelemetry-sdk", "opentelemetry-exporter-otlp-proto-http"} <= set(closure(extras(dockerfile)))
