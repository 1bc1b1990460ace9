"""The same six frames as an app or data set writes them: each goes in as it is, and a textured model comes out."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import pytest
from live_service import LiveService

from advtex_client import Client
from advtex_contract.jobs import JobState, JobView
from advtex_contract.options import JobOptions, Preset
from advtex_engine import pipeline
from advtex_engine.mesh import fusion
from advtex_scan import check_scan
from advtex_store.keys import scan_key
from advtex_worker.adapt import texture_config

FORMATS = Path(os.environ.get("ADVTEX_DATA", Path(__file__).parents[2].parent / "shared" / "data")) / "formats"
SAMPLES = {
    "3d_scanner_app": "scanner_app",
    "arkitscenes": "arkitscenes",
    "bundlefusion_7scenes": "seven_scenes",
    "nerfstudio": "nerfstudio",
    "polycam_raw": "polycam",
    "record3d/tiny.r3d": "record3d",
    "redwood_open3d": "redwood",
    "replica_niceslam": "replica",
    "scannet_export": "scannet",
    "scannet_sens/tiny.sens": "sens",
    "stray_scanner": "stray_scanner",
    "tum_rgbd": "tum",
}
OPTIONS = JobOptions(preset=Preset.preview, width=96, height=72, steps=2, face_budget=500, max_texture_size=512)

pytestmark = [
    pytest.mark.data,
    pytest.mark.skipif(not FORMATS.is_dir(), reason="the sample formats are not there; point ADVTEX_DATA at them"),
]


@pytest.mark.slow
def test_every_sample_is_accepted_and_what_arrived_is_textured(
    service: LiveService, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the engine in this process, on coarse voxels, with cameras as given and no previews."""
    monkeypatch.setattr(fusion, "COARSEST", 0.08)
    monkeypatch.setattr(fusion, "FINEST", 0.08)
    monkeypatch.setattr(pipeline, "write_gallery", lambda *_: ())
    monkeypatch.setattr(pipeline, "write_page", lambda *_: ())  # which shows them
    config = replace(texture_config(OPTIONS, "cpu"), refine=False)
    with service.client() as client:
        for name, job in submit_all(client).items():
            upload = client.get_job(job.id).upload_id
            assert upload is not None
            stored = tmp_path / "scan.zip"
            service.store.blobs.fetch(scan_key(upload), stored)
            out = tmp_path / name.replace("/", "-")
            pipeline.texture_scan(stored, out, config, work=tmp_path / "work")
            check_result(name, out)


@pytest.mark.soak
def test_every_sample_becomes_a_model(service: LiveService, tmp_path: Path) -> None:
    service.start_worker("coarse")
    with service.client() as client:
        for name, job in submit_all(client).items():
            done = client.wait_for_job(job.id, timeout=120)
            assert done.state is JobState.succeeded, name
            out = tmp_path / name.replace("/", "-")
            client.download_results(done, out)
            check_result(name, out)


def submit_all(client: Client) -> dict[str, JobView]:
    jobs = {}
    for name, layout in SAMPLES.items():
        report = check_scan(FORMATS / name)
        assert (report.ok, report.layout) == (True, layout), report.format_text()
        jobs[name] = client.submit(FORMATS / name, OPTIONS, label=name)
        assert jobs[name].state is not JobState.rejected, name
    return jobs


def check_result(name: str, out: Path) -> None:
    report = json.loads((out / "report.json").read_text())
    frames = 5 if name == "3d_scanner_app" else 6  # one has a pose but no image
    assert report["fusion"]["frames"] == report["scan"]["views"] == frames
    assert report["touched_texels"] > 1_000
    assert (out / "model.glb").stat().st_size > 10_000
