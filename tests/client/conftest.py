from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))


@pytest.fixture(autouse=True)
def own_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither the user's configuration nor the state of earlier runs reaches a test."""
    for name in ("ADVTEX_URL", "ADVTEX_API_KEY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("ADVTEX_DATA_DIR", str(tmp_path / "data"))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))


@pytest.fixture
def scan(tmp_path: Path) -> Path:
    from tiny_scan import write_scan

    return write_scan(tmp_path / "scan")


@pytest.fixture(autouse=True)
def no_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pauses between tries are decided as ever, and then not made."""
    monkeypatch.setattr("advtex_client.client.time.sleep", lambda _seconds: None)
