"""Photographs with their cameras: `previews/photographs.json` and its stream."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from lumigraph import photographed_scene

from advtex_engine.core.cameras import project, scaled_camera
from advtex_engine.core.scene import TO_Y_UP, Camera, View
from advtex_engine.results.photographs import LONGEST_SIDE, MAX_HELDOUT, MAX_PHOTOGRAPHS, photograph_stream
from advtex_scan.matrices import from_quaternion

CORNER = torch.tensor([[0.5, 0.4, 0.3]])  # of the box


def read(entry: dict[str, Any], stream: bytes) -> Any:
    jpeg = stream[entry["offset"] : entry["offset"] + entry["bytes"]]
    image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return image[..., ::-1].astype(np.float64)


def test_each_lies_in_the_stream_and_has_its_camera_in_the_world_of_the_glb() -> None:
    scene, atlas, texture = photographed_scene()
    entries, stream = photograph_stream(replace(scene, up_axis="-x"), atlas, texture)
    to_glb = np.array(from_quaternion(*TO_Y_UP["-x"], (0.0, 0.0, 0.0)))
    assert [entry["name"] for entry in entries] == [view.name for view in scene.views]
    assert entries[-1]["offset"] + entries[-1]["bytes"] == len(stream)
    for entry, view in zip(entries, scene.views, strict=True):
        assert np.abs(read(entry, stream) - view.color.numpy()).mean() < 12, "more than JPEG and toning change"
        to_camera = torch.tensor(np.linalg.inv(entry["camera_to_world"]) @ to_glb)
        place = Camera(torch.tensor(entry["K"]).double(), to_camera, entry["width"], entry["height"])
        assert project(place, CORNER)[0].numpy() == pytest.approx(project(view.camera, CORNER)[0].numpy(), abs=1e-4)


def test_they_have_the_tones_of_the_texture() -> None:
    scene, atlas, texture = photographed_scene()
    entries, stream = photograph_stream(scene, atlas, texture - 0.08)
    middle = (slice(60, 80), slice(50, 110))
    for entry, view in zip(entries, scene.views, strict=True):
        moved = read(entry, stream)[middle].mean() - view.color.numpy()[middle].mean()
        assert moved == pytest.approx(-0.08 * 255, abs=2), "the stripes stay, their tone goes with the texture"


def test_there_are_not_too_many_and_none_too_large_and_those_held_out_are_marked() -> None:
    scene, atlas, texture = photographed_scene()
    view = scene.views[0]
    place = scaled_camera(view.camera, 10 * view.camera.width, 10 * view.camera.height)
    large = View("large.png", place, view.color.repeat_interleave(10, 0).repeat_interleave(10, 1))
    heldout = tuple(replace(view, name=f"heldout{number}") for number in range(MAX_HELDOUT + 2))
    many = replace(scene, views=(large, *[view] * (MAX_PHOTOGRAPHS + 3)), heldout=heldout)
    entries, stream = photograph_stream(many, atlas, texture)
    assert [entry["heldout"] for entry in entries] == [False] * MAX_PHOTOGRAPHS + [True] * MAX_HELDOUT
    assert (entries[0]["width"], entries[0]["height"]) == (LONGEST_SIDE, LONGEST_SIDE * 3 // 4)
    assert entries[0]["K"][0][0] == pytest.approx(4 * entries[1]["K"][0][0])
    assert read(entries[0], stream).shape == (480, 640, 3)
