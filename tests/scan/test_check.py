"""The report: every problem by name, with file and remedy, and nothing else."""

from __future__ import annotations

import json
import math

import pytest

from advtex_scan import CheckReport, check_scan, open_scan, read_scan

NAN = math.nan


def errors(report: CheckReport) -> dict[str, str]:
    """Code -> where of all errors."""
    return {finding.code: finding.where for finding in report.findings if finding.severity == "error"}


def codes(report: CheckReport, severity: str) -> set[str]:
    return {finding.code for finding in report.findings if finding.severity == severity}


def test_a_sound_scan_has_nothing_to_report(maker):
    report = check_scan(maker.native().folder())
    assert report.ok
    assert report.findings == ()
    assert (report.layout, report.frames_found, report.frames_usable, report.dropped) == ("native", 5, 5, {})
    mesh = report.mesh
    assert (mesh.path, mesh.vertices, mesh.faces, mesh.has_uv) == ("mesh.ply", 8, 12, False)
    assert mesh.bounds == ((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
    assert check_scan(maker.zip(prefix="top/")) == report


def frame(maker, index):
    return maker.scan["frames"][index]


def no_mesh(maker, make):
    del maker.scan["mesh"]
    for frame in maker.scan["frames"]:
        del frame["depth"]


def mesh_not_there(maker, make):
    maker.scan["mesh"] = "gone.ply"


def too_few(maker, make):
    del maker.scan["frames"][2:]


def same_name(maker, make):
    frame(maker, 0)["name"] = frame(maker, 3)["name"] = "twin"


def not_a_rotation(maker, make):
    frame(maker, 1)["camera_to_world"][0][0] += 0.1


def mirrored(maker, make):
    for row in frame(maker, 1)["camera_to_world"][:3]:
        row[0] *= -1


def pose_with_nan(maker, make):
    frame(maker, 1)["camera_to_world"][0][3] = NAN


def pose_not_a_matrix(maker, make):
    frame(maker, 1)["camera_to_world"] = [1, 2, 3]


def pose_last_row(maker, make):
    frame(maker, 1)["camera_to_world"][3][0] = 1


def no_color_intrinsics(maker, make):
    del maker.scan["color_intrinsics"]


def no_depth_intrinsics(maker, make):
    del maker.scan["depth_intrinsics"]


def bad_intrinsics(maker, make):
    maker.scan["color_intrinsics"]["fx"] = -1


def image_is_none(maker, make):
    maker.files["color/2.png"] = b"hello"


def image_cut(maker, make):
    maker.files["color/2.png"] = make.png()[:20]


def image_without_end(maker, make):
    maker.files["color/2.png"] = make.png()[:-20]


def depth_without_end(maker, make):
    maker.files["depth/2.png"] = make.depth_png()[:-20]


def image_huge(maker, make):
    maker.files["color/2.png"] = make.png(15000, 15000)


def image_of_other_shape(maker, make):
    maker.files["color/2.png"] = make.png(32, 32)


def depth_of_other_size(maker, make):
    maker.files["depth/2.png"] = make.depth_png(16, 12)


def depth_of_8_bits(maker, make):
    maker.files["depth/2.png"] = make.png(bits=8, color_type=0)


def depth_as_jpeg(maker, make):
    maker.files["depth/2.png"] = make.jpeg()


def image_missing(maker, make):
    del maker.files["color/2.png"]


def wrong_version(maker, make):
    maker.scan["version"] = 2


def bad_up_axis(maker, make):
    maker.scan["up_axis"] = "up"


def bad_depth_scale(maker, make):
    maker.scan["depth_scale"] = 0


def no_frames(maker, make):
    maker.scan["frames"] = {}


def no_faces(maker, make):
    maker.files["mesh.ply"] = make.ply(faces=[])


def index_out_of_range(maker, make):
    maker.files["mesh.ply"] = make.ply(faces=[(0, 1, 8)])


def mesh_nan(maker, make):
    maker.files["mesh.ply"] = make.ply([(NAN, 0, 0), *make.corners[1:]])


def zero_area(maker, make):
    maker.files["mesh.ply"] = make.ply(faces=[(0, 0, 1), (2, 2, 2)])


def mesh_far(maker, make):
    maker.files["mesh.ply"] = make.ply([(x + 1000, y, z) for x, y, z in make.corners])


def looks_away(maker, make):
    for one in maker.scan["frames"]:
        for row in one["camera_to_world"][:3]:  # half a turn about the camera's y axis
            row[0], row[2] = -row[0], -row[2]


@pytest.mark.parametrize(
    ("spoil", "expected"),
    [
        (no_mesh, {"no_mesh": ""}),
        (mesh_not_there, {"missing_file": "scan.json: mesh"}),
        (too_few, {"too_few_frames": ""}),
        (same_name, {"duplicate_frame": "twin"}),
        (not_a_rotation, {"bad_pose": "scan.json: frames[1].camera_to_world"}),
        (mirrored, {"bad_pose": "scan.json: frames[1].camera_to_world"}),
        (pose_with_nan, {"bad_pose": "scan.json: frames[1].camera_to_world"}),
        (pose_last_row, {"bad_pose": "scan.json: frames[1].camera_to_world"}),
        (pose_not_a_matrix, {"bad_value": "scan.json: frames[1].camera_to_world"}),
        (
            no_color_intrinsics,
            {"no_color_intrinsics": "scan.json: frames[0], scan.json: frames[1], scan.json: frames[2] and 2 more"},
        ),
        (no_depth_intrinsics, {"no_depth_intrinsics": "depth/0.png, depth/1.png, depth/2.png and 2 more"}),
        (bad_intrinsics, {"bad_intrinsics": "scan.json: color_intrinsics"}),
        (image_is_none, {"not_an_image": "color/2.png"}),
        (image_cut, {"not_an_image": "color/2.png"}),
        (image_without_end, {"truncated_image": "color/2.png"}),
        (depth_without_end, {"truncated_image": "depth/2.png"}),
        (image_huge, {"image_too_large": "color/2.png"}),
        (image_of_other_shape, {"color_size": "color/2.png"}),
        (depth_of_other_size, {"depth_size": "depth/2.png"}),
        (depth_of_8_bits, {"depth_format": "depth/2.png"}),
        (depth_as_jpeg, {"depth_format": "depth/2.png"}),
        (image_missing, {"missing_file": "scan.json: frames[2].color"}),
        (wrong_version, {"bad_version": "scan.json"}),
        (bad_up_axis, {"bad_value": "scan.json: up_axis"}),
        (bad_depth_scale, {"bad_value": "scan.json: depth_scale"}),
        (no_frames, {"bad_value": "scan.json: frames", "too_few_frames": ""}),
        (no_faces, {"mesh_no_faces": "mesh.ply"}),
        (index_out_of_range, {"mesh_index": "mesh.ply"}),
        (mesh_nan, {"mesh_nan": "mesh.ply"}),
        (zero_area, {"mesh_zero_area": "mesh.ply"}),
        (mesh_far, {"mesh_far": "mesh.ply", "mesh_unseen": "mesh.ply"}),
        (looks_away, {"mesh_unseen": "mesh.ply"}),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_each_problem_is_one_error(maker, make, spoil, expected):
    maker.native()
    spoil(maker, make)
    report = check_scan(maker.folder())
    shown = {code: where for code, where in errors(report).items() if code != "too_few_frames" or code in expected}
    assert shown == expected
    assert not report.ok
    for finding in report.findings:
        assert finding.message
        assert finding.remedy or finding.severity == "info"


def test_all_problems_are_reported_at_once(maker, make):
    maker.native()
    spoilers = (not_a_rotation, image_is_none, depth_of_other_size, zero_area, bad_up_axis, same_name)
    for spoil in spoilers:
        spoil(maker, make)
    frame(maker, 4)["depth"] = "gone.png"
    expected = {
        "bad_pose",
        "not_an_image",
        "depth_size",
        "mesh_zero_area",
        "bad_value",
        "duplicate_frame",
        "missing_file",
    }
    assert expected <= set(errors(check_scan(maker.folder())))


def test_problems_of_one_kind_with_different_remedies_are_told_apart(maker):
    maker.native()
    maker.scan |= {"up_axis": "up", "depth_scale": -1}
    places = [finding.where for finding in check_scan(maker.folder()).findings]
    assert places == ["scan.json: up_axis", "scan.json: depth_scale"]


def test_lost_and_missing_poses_are_dropped_and_counted(maker):
    maker.native(9)
    frame(maker, 0)["camera_to_world"] = [[-math.inf] * 4] * 4
    frame(maker, 1)["camera_to_world"] = [None] * 16
    del frame(maker, 2)["camera_to_world"]
    report = check_scan(maker.folder())
    assert report.ok
    assert report.dropped == {"lost_tracking": 2, "missing_pose": 1}
    assert (report.frames_found, report.frames_usable) == (9, 6)
    assert codes(report, "warning") == {"lost_tracking", "missing_pose"}


def test_many_bad_frames_are_one_finding(maker):
    maker.native(6)
    bad = {**frame(maker, 0), "camera_to_world": [2.0] * 16}
    maker.scan["frames"] += [bad] * 2500
    report = check_scan(maker.folder())
    assert len(report.findings) == 1
    assert report.findings[0].where.endswith("frames[8].camera_to_world and 2497 more")
    assert "2500 in all" in report.findings[0].message
    assert len(report.format_text().splitlines()) < 10


def test_colors_of_another_size_and_the_same_shape_are_rescaled(maker, make):
    maker.native()
    maker.files["color/2.png"] = make.png(64, 48)
    with open_scan(maker.folder()) as archive:
        reading = read_scan(archive)
    assert reading.report.ok
    assert codes(reading.report, "warning") == {"color_scaled"}
    camera = reading.manifest.frames[2].color_intrinsics
    assert (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height) == (60, 60, 32, 24, 64, 48)


def test_other_warnings_and_notes(maker, make):
    maker.native()
    maker.scan["depth_scael"] = 1000
    maker.scan["color_intrinsics"]["cx"] = 1.0
    del frame(maker, 3)["depth"]
    maker.files["mesh.ply"] = make.ply([(x * 500, y * 500, z * 500) for x, y, z in make.corners])
    maker.files["readme.txt"] = b"hello"
    report = check_scan(maker.folder())
    assert report.ok
    assert codes(report, "warning") == {"unknown_key", "off_center", "mesh_large"}
    assert codes(report, "info") == {"no_depth", "ignored_file"}
    ignored = [finding.where for finding in report.findings if finding.code == "ignored_file"]
    assert ignored == ["depth/3.png, readme.txt"]


def test_a_frame_that_sees_nothing_is_named(maker, make):
    maker.native()
    for row in frame(maker, 2)["camera_to_world"][:3]:
        row[0], row[2] = -row[0], -row[2]
    report = check_scan(maker.folder())
    assert report.ok
    assert [finding.where for finding in report.findings] == ["000002"]


def test_a_camera_before_the_middle_of_a_large_wall_sees_it(maker, make):
    """No vertex is in its picture, only the inside of a face."""
    maker.native()
    wall = [(0, -50, -50), (0, 50, -50), (0, 50, 50), (0, -50, 50)]
    maker.files["mesh.ply"] = make.ply(wall, [(0, 1, 2), (0, 2, 3)])
    maker.scan["frames"] = [{**frame(maker, 0), "name": str(i)} for i in range(3)]
    pose = make.look_at(0.0, distance=8.0)
    for one in maker.scan["frames"]:
        one["camera_to_world"] = pose
    report = check_scan(maker.folder())
    assert report.ok
    assert codes(report, "warning") == set()


def test_frames_of_cameras_that_touch_no_layout(maker, tmp_path):
    (tmp_path / "empty").mkdir()
    assert errors(check_scan(tmp_path / "empty")) == {"unknown_layout": ""}
    (tmp_path / "empty" / "a.txt").write_text("hello")
    report = check_scan(tmp_path / "empty")
    assert errors(report) == {"unknown_layout": ""}
    assert "scan.json" in report.findings[0].remedy


def test_what_cannot_be_opened_is_a_report_too(tmp_path):
    (tmp_path / "scan.zip").write_bytes(b"no zip")
    for path in (tmp_path / "scan.zip", tmp_path / "absent"):
        report = check_scan(path)
        assert not report.ok
        assert report.findings[0].where == path.name
        assert "not recognized" in report.format_text()


def test_broken_json_says_where(maker):
    maker.files = {"scan.json": b'{"version": 1,,}'}
    report = check_scan(maker.folder())
    assert errors(report) == {"bad_json": "scan.json"}
    assert "column" in report.findings[0].message
    for content in (b"[" * 100_000, b"[]", b"\xff\xfe", b'{"version": 1, "frames": 1' + b"0" * 10_000 + b"}"):
        maker.files = {"scan.json": content}
        assert not check_scan(maker.folder()).ok


def test_a_report_is_json_and_text(maker):
    maker.native()
    maker.scan["frames"][0]["camera_to_world"] = [None] * 16
    no_mesh(maker, None)
    report = check_scan(maker.folder())
    as_json = json.loads(json.dumps(report.to_dict(), allow_nan=False))
    assert as_json["ok"] is False
    assert as_json["dropped"] == {"lost_tracking": 1}
    assert as_json["mesh"] is None
    assert set(as_json["findings"][0]) == {"severity", "code", "where", "message", "remedy"}
    text = report.format_text()
    assert "4 usable of 5 (left out: 1 lost tracking)" in text
    assert "layout   native, 100% sure: scan.json is there" in text
    assert "error    there is neither a mesh nor depth" in text
    assert text.endswith("this scan cannot be textured as it is")


def test_seven_scenes_without_any_sound_image_names_the_images(maker, make):
    maker.files = {"camera-intrinsics.txt": b"1 0 1 0 1 1 0 0 1", "mesh.ply": make.ply()}
    for i in range(4):
        maker.files[f"frame-{i:06d}.color.png"] = b"hello"
        maker.files[f"frame-{i:06d}.pose.txt"] = b"1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"
    report = check_scan(maker.folder())
    assert set(errors(report)) == {"not_an_image", "too_few_frames"}
    assert "and 1 more" in errors(report)["not_an_image"]


def test_seven_scenes_with_bad_text_files(maker, make):
    maker.files = {"camera-intrinsics.txt": b"1 0 1", "mesh.ply": make.ply()}
    for i in range(4):
        maker.files[f"frame-{i:06d}.color.png"] = make.png()
        maker.files[f"frame-{i:06d}.pose.txt"] = b"one two"
    del maker.files["frame-000003.pose.txt"]
    report = check_scan(maker.folder())
    assert set(errors(report)) == {"bad_numbers", "no_color_intrinsics", "too_few_frames"}
    assert report.dropped == {"missing_pose": 1}
