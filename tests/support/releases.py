"""Releases of this repository that run side by side: each has a tree and a Python of its own, all the same
dependencies."""

from __future__ import annotations

import io
import subprocess
import sys
import tarfile
import venv
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = ("client", "server", "worker")
SUPPORT = Path("tests") / "support"


@dataclass(frozen=True)
class Release:
    """python: an interpreter that finds the release's packages. path: where its processes find more."""

    python: str
    path: tuple[str, ...]
    tree: Path

    @property
    def support(self) -> Path:
        return self.tree / SUPPORT

    @property
    def newest_schema(self) -> str:
        names = (self.tree / "server/advtex_store/migrations/versions").glob("v*.py")
        return max(name.stem[1:5] for name in names)


PRESENT = Release(
    sys.executable, tuple(str(Path(entry).absolute()) for entry in (*sys.path, ROOT / SUPPORT) if entry), ROOT
)


def checked_out(revision: str, folder: Path) -> Release:
    """The release of a commit, in a new folder. The test is skipped where the repository does not have the commit."""
    wanted = ["git", "-C", str(ROOT), "archive", "--format=tar", revision, *PACKAGES, str(SUPPORT)]
    try:
        archive = subprocess.run(wanted, capture_output=True, check=True).stdout
    except FileNotFoundError:
        pytest.skip("git is not installed: there is no earlier release to run")
    except subprocess.CalledProcessError as error:
        pytest.skip(
            f"there is no earlier release here (a shallow clone, no checkout?): {error.stderr.decode().strip()}"
        )
    tree = folder / "tree"
    with tarfile.open(fileobj=io.BytesIO(archive)) as packed:
        packed.extractall(tree, filter="data")
    environment = folder / "venv"
    venv.EnvBuilder(symlinks=True, with_pip=False).create(environment)
    (site,) = environment.glob("lib/python3*/site-packages")
    dependencies = [entry for entry in sys.path if Path(entry).name in ("site-packages", "dist-packages")]
    lines = [*(str(tree / name) for name in PACKAGES), *dependencies]  # the release's own packages are found first
    (site / "release.pth").write_text("\n".join(lines) + "\n")
    return Release(str(environment / "bin" / "python"), (str(tree / SUPPORT),), tree)
