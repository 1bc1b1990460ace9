"""One version: pyproject.toml states it, and everything else that names one names the same."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from importlib.metadata import version
from pathlib import Path

import pytest
import yaml

from advtex_client._http import base_headers
from advtex_client.config import ClientConfig
from advtex_scan.version import product_version
from advtex_server.app import create_app
from advtex_server.settings import ServerSettings

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
VERSION = PROJECT["version"]


def test_the_installed_package_has_it() -> None:
    assert version("advtex") == VERSION, "make install brings what is installed up to pyproject.toml"
    assert product_version() == VERSION


@pytest.mark.parametrize("command", sorted(PROJECT["scripts"]))
def test_every_command_prints_it(command: str) -> None:
    module, _, function = PROJECT["scripts"][command].partition(":")
    code = f"import sys; from {module} import {function} as main; sys.argv[0] = {command!r}; sys.exit(main())"
    done = subprocess.run(
        [sys.executable, "-c", code, "--version"], capture_output=True, text=True, timeout=120, check=False
    )
    assert (done.returncode, done.stdout) == (0, f"{command} {VERSION}\n"), done.stderr


def test_the_api_describes_itself_by_it(tmp_path: Path) -> None:
    app = create_app(ServerSettings(data_dir=tmp_path))
    assert app.openapi()["info"]["version"] == VERSION


def test_the_client_calls_itself_by_it() -> None:
    assert base_headers(ClientConfig("http://server", ""))["User-Agent"] == f"advtex-client/{VERSION}"


def test_the_images_are_tagged_with_it() -> None:
    services = yaml.safe_load((ROOT / "compose.yaml").read_text(encoding="utf-8"))["services"]
    built = {service["build"]["dockerfile"]: service["image"] for service in services.values() if "build" in service}
    names = {path.name.partition(".")[0] for path in (ROOT / "docker").glob("*.Dockerfile")}
    assert built == {f"docker/{name}.Dockerfile": f"advtex-{name}:{VERSION}" for name in names}
    kustomization = yaml.safe_load((ROOT / "docker/kubernetes/kustomization.yaml").read_text(encoding="utf-8"))
    assert kustomization["images"] == [{"name": f"advtex-{name}", "newTag": VERSION} for name in sorted(names)]


def test_pages_name_images_by_it() -> None:
    named = {
        tag
        for page in (ROOT / "README.md", *ROOT.glob("*/README.md"))
        for tag in re.findall(r"advtex-(?:server|worker):([\w.]+)", page.read_text(encoding="utf-8"))
    }
    assert named == {VERSION}


def test_the_citation_names_it() -> None:
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))["version"] == VERSION


def test_the_changelog_begins_with_it() -> None:
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    heads = re.findall(r"^## \[(.+?)\] - (\d{4}-\d\d-\d\d|unreleased)$", text, re.MULTILINE)
    assert len(heads) == text.count("\n## ")
    assert heads[0][0] == VERSION
