"""Which layout a scan is read as, what it may lack, and what `scan.json` takes of what apps record."""

from __future__ import annotations

import numpy as np
from app_captures import HEIGHT, WIDTH, circle, gray, polycam

from advtex_scan import Distortion, check_scan, open_scan, read_scan
from advtex_scan.layouts import LAYOUT_NAMES


def reading(path, layout=None):
    with open_scan(path) as archive:
        return read_scan(archive, layout)


def codes(report, severity: str = "error") -> set[str]:
    return {finding.code for finding in report.findings if finding.severity == severity}


def errors(report) -> dict[str, str]:
    return {finding.code: finding.where for finding in report.findings if finding.severity == "error"}


def test_a_scan_without_a_mesh_is_sound_if_it_has_depth(maker):
    maker.native()
    del maker.scan["mesh"]
    found = reading(maker.folder())
    assert found.report.ok
    assert found.manifest.mesh is None
    assert {
        (finding.severity, finding.code) for finding in found.report.findings if finding.code != "ignored_file"
    } == {("info", "mesh_fused")}


def two_layouts(maker, make):
    """A native scan whose files are also those of ScanNet."""
    maker.native()
    for i in range(5):
        maker.files[f"pose/{i}.txt"] = b"1 0 0 0 0 1 0 0 0 0 1 -2 0 0 0 1"
    for kind in ("color", "depth"):
        maker.files[f"intrinsic/intrinsic_{kind}.txt"] = b"30 0 15.5 0 30 11.5 0 0 1"


def test_the_surest_layout_is_taken_and_the_others_are_named(maker, make):
    two_layouts(maker, make)
    report = check_scan(maker.folder())
    assert (report.layout, report.sureness) == ("native", 1.0)
    others = [finding for finding in report.findings if finding.code == "other_layout"]
    assert "scannet (95% sure: " in others[0].message
    assert "--layout scannet" in others[0].remedy


def test_a_layout_that_is_asked_for_is_taken(maker, make):
    two_layouts(maker, make)
    found = reading(maker.folder(), "scannet")
    assert found.report.ok
    assert found.report.layout == found.manifest.layout == "scannet"


def test_a_layout_that_is_unknown_or_does_not_fit_is_an_error_that_helps(maker, make):
    two_layouts(maker, make)
    unknown = reading(maker.folder(), "skannet")
    assert (unknown.manifest, errors(unknown.report)) == (None, {"unknown_layout": ""})
    assert all(name in unknown.report.findings[0].remedy for name in LAYOUT_NAMES)
    other = check_scan(maker.folder(), "sens")
    assert errors(other) == {"unknown_layout": ""}
    assert "they look like native: scan.json is there" in other.findings[0].message


def test_a_mesh_is_looked_at_where_it_was_moved_to(maker, make):
    """The check of whether cameras see the mesh knows of its transform."""
    away = np.eye(4)
    away[:3, 3] = 1000.0
    maker.files = polycam(circle(make), make) | {"raw.ply": make.ply()}
    maker.native()
    maker.scan["mesh_to_world"] = away.tolist()
    assert codes(reading(maker.folder()).report) == {"mesh_far", "mesh_unseen"}
    maker.files["mesh.ply"] = make.ply([(x - 1000, y - 1000, z - 1000) for x, y, z in make.corners])
    assert reading(maker.folder()).report.ok


def test_native_takes_what_apps_record(maker, make):
    maker.native()
    for i, frame in enumerate(maker.scan["frames"]):
        maker.files |= {f"confidence/{i}.png": gray(make, WIDTH, HEIGHT), f"mask/{i}.png": gray(make, WIDTH, HEIGHT)}
        frame |= {"confidence": f"confidence/{i}.png", "mask": f"mask/{i}.png"}
    maker.scan["color_intrinsics"] |= {"k1": 0.1, "p2": -0.01, "k3": None}
    maker.scan |= {"confidence_max": 2, "mesh_to_world": np.eye(4).tolist()}
    found = reading(maker.folder())
    assert found.report.findings == ()
    frame = found.manifest.frames[2]
    assert (frame.confidence, frame.mask, found.manifest.confidence_max) == ("confidence/2.png", "mask/2.png", 2)
    assert frame.color_intrinsics.distortion == Distortion(k1=0.1, p2=-0.01)
    assert frame.depth_intrinsics.distortion is None
    maker.scan |= {"confidence_max": 300, "mesh_to_world": [1]}
    maker.scan["color_intrinsics"]["k1"] = "bent"
    assert codes(reading(maker.folder()).report) >= {"bad_value", "bad_transform", "bad_intrinsics"}


def test_what_is_no_scan_says_what_is_there_and_what_to_export(maker, make):
    maker.files = {"model.glb": b"", "textures/a.jpg": make.jpeg(), "textures/b.png": make.png(), "notes.txt": b""}
    (finding,) = reading(maker.folder()).report.findings
    assert (finding.severity, finding.code) == ("error", "unknown_layout")
    assert "2 images, 1 meshes or point clouds" in finding.message
    assert "raw data" in finding.remedy
