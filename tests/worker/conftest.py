from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from advtex_contract.jobs import JobSpec
from advtex_contract.options import JobOptions
from advtex_store import keys
from advtex_store.database import upgrade_database
from advtex_store.store import Store, open_store
from advtex_worker.settings import WorkerSettings
from advtex_worker.tasks import Host

SUPPORT = Path(__file__).parents[1] / "support"
sys.path.insert(0, str(SUPPORT))


@pytest.fixture
def settings(tmp_path: Path, place: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> WorkerSettings:
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([*sys.path, str(SUPPORT)]))
    rhythm = {"lease_seconds": 10.0, "grace_seconds": 1.0, "heartbeat_seconds": 0.05}
    return WorkerSettings(data_dir=tmp_path / "data", device="cpu", threads=1, **rhythm, **place)


@pytest.fixture
def store(settings: WorkerSettings) -> Iterator[Store]:
    upgrade_database(settings.database)
    opened = open_store(settings)
    yield opened
    opened.close()


@pytest.fixture
def host(settings: WorkerSettings) -> Callable[[str], Host]:
    """A worker's host whose engine is the named one of `fake_engines`."""
    return lambda name: Host(settings, engine=f"fake_engines:{name}")


@pytest.fixture
def new_job(store: Store) -> Callable[..., str]:
    """Makes a queued job and returns its id; the arguments are its options."""

    def make(**options: object) -> str:
        data = b"a scan"
        upload = store.uploads.create("owner", len(data))
        written = store.blobs.put(keys.scan_key(upload.id), data)
        store.uploads.finish(upload.id, written.sha256)
        spec = JobSpec(upload_id=upload.id, options=JobOptions.model_validate(options))
        from checked import queued_job

        return queued_job(store, "owner", spec)

    return make
