"""Each error of the camera is as large as its physics says, and is not there when it is switched off."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))
from small_room import WALL, passing, pinhole, striped_wall

from advtex_engine.synthetic import camera as module
from advtex_engine.synthetic.camera import Errors, Exposure, automatics, blur_pixels, compressed, develop, expose
from advtex_engine.synthetic.patches import GAMMA, DrawnScene

NONE = Errors.none()
CAMERA = pinhole()
STILL = Exposure(0.0, 0.0, 1.0)


@pytest.fixture(scope="module")
def wall() -> DrawnScene:
    return striped_wall()


def only(name: str) -> Errors:
    return dataclasses.replace(NONE, **{name: True})


def edge_of(light: np.ndarray) -> np.ndarray:
    """Where each row [W] turns from 0.2 to 0.8, in pixels."""
    return light.shape[1] - (light[..., 0] - 0.2).sum(1) / 0.6


def length_of(light: np.ndarray) -> float:
    """The length in pixels of the ramp from 0.2 to 0.8, from its variance; a pixel and a difference have their own."""
    slope = np.diff((light[20, :, 0] - 0.2) / 0.6)
    at = np.arange(len(slope))
    variance = (slope * at**2).sum() - (slope * at).sum() ** 2
    return float(np.sqrt(max(12 * variance - 2, 0)))


def test_blur_is_as_long_as_speed_times_exposure_times_focal_length_over_distance(wall: DrawnScene) -> None:
    exposure = Exposure(0.0, 0.2, 1.0)
    light = expose(wall, passing(0.8), CAMERA, exposure, only("blur"))
    length = 0.8 * 0.2 * 100 / WALL
    assert length_of(light) == pytest.approx(length, rel=0.05)
    assert blur_pixels(passing(0.8), CAMERA, exposure, np.array([[0.0, WALL, 0.0]])) == pytest.approx(length, rel=1e-6)
    assert length_of(expose(wall, passing(0.8), CAMERA, STILL, NONE)) < 0.5


def test_a_rolling_shutter_leans_a_vertical_edge_by_readout_times_speed(wall: DrawnScene) -> None:
    straight = edge_of(expose(wall, passing(4.0), CAMERA, STILL, NONE))
    leaning = edge_of(expose(wall, passing(4.0), CAMERA, STILL, only("rolling_shutter")))
    assert np.abs(straight - CAMERA.width / 2).max() < 0.05
    # The camera moves to the right while rows are read: what it sees moves to the left.
    expected = -4.0 * 100 / WALL * module.READOUT
    slope = np.polyfit(np.arange(CAMERA.height), leaning, 1)[0] * CAMERA.height
    assert slope == pytest.approx(expected, rel=0.03)
    assert leaning[CAMERA.height // 2] == pytest.approx(CAMERA.width / 2, abs=0.1)


def test_the_lens_bends_lines_as_its_coefficients_say(wall: DrawnScene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "DISTORTION", (0.2, -0.1))
    # Half a metre to the right of the edge, it is seen left of the middle.
    path, beside = passing(0.0), np.array([0.5, 0.0, 0.0])
    path = dataclasses.replace(path, places=path.places + beside, targets=path.targets + beside)
    bent = edge_of(expose(wall, path, CAMERA, STILL, only("distortion")))
    assert np.abs(edge_of(expose(wall, path, CAMERA, STILL, NONE)) - (48 - 25)).max() < 0.05
    matrix = CAMERA.K.numpy()
    line = np.stack([np.full(61, -0.25), np.linspace(-0.5, 0.5, 61), np.ones(61)], -1)
    seen, _ = cv2.projectPoints(line, np.zeros(3), np.zeros(3), matrix, np.array([0.2, -0.1, 0, 0]))
    rows = np.arange(CAMERA.height) + 0.5
    expected = np.interp(rows, seen[:, 0, 1], seen[:, 0, 0])
    assert np.abs(bent - expected).max() < 0.1
    assert np.ptp(expected) > 0.5


def test_vignetting_darkens_corners_by_a_share_of_the_cosine_fourth_law() -> None:
    light = np.full((72, 96, 3), 0.5, np.float32)
    photo = develop(light, CAMERA, STILL, only("vignetting"), np.random.default_rng(0))
    linear = (photo / 255) ** GAMMA
    cosine = 1 / np.sqrt(1 + (0.475**2 + 0.355**2))
    assert linear[0, 0] == pytest.approx(0.5 * (1 - module.VIGNETTING * (1 - cosine**4)), abs=0.005)
    assert linear[36, 48] == pytest.approx(0.5, abs=0.005)
    assert (np.diff(photo[36, 48:, 0].astype(int)) <= 0).all()


def test_without_errors_a_photograph_is_the_light_in_srgb() -> None:
    light = np.linspace(0, 1.5, 72 * 96 * 3, dtype=np.float32).reshape(72, 96, 3)
    photo = develop(light, CAMERA, STILL, NONE, np.random.default_rng(0))
    assert np.abs(photo - 255 * np.clip(light, 0, 1) ** (1 / GAMMA)).max() <= 0.51


def test_a_lamp_clips_at_every_exposure_and_exposure_clips_more() -> None:
    light = np.random.default_rng(0).uniform(0, 1, (72, 96, 3)).astype(np.float32)
    light[:10] = 7.0
    shares = [
        (develop(light, CAMERA, Exposure(0, 0, gain), NONE, np.random.default_rng(0)) == 255).mean()
        for gain in (0.5, 1.0, 2.0)
    ]
    assert shares[0] == pytest.approx(10 / 72, abs=1e-6)
    assert shares[2] == pytest.approx(10 / 72 + 62 / 72 / 2, abs=0.02)


def test_noise_is_shot_noise_and_read_noise() -> None:
    for level in (0.0, 0.05, 0.4):
        light = np.full((240, 320, 3), level + 0.02, np.float32)
        photo = develop(light, pinhole(320, 240), STILL, only("noise"), np.random.default_rng(1))
        deviation = ((photo / 255) ** GAMMA).std()
        expected = np.sqrt(module.SHOT_NOISE * (level + 0.02) + module.READ_NOISE**2)
        assert deviation == pytest.approx(expected, rel=0.1)


def test_jpeg_costs_little_and_saves_much() -> None:
    noise = cv2.GaussianBlur(np.random.default_rng(0).uniform(0, 255, (72, 96, 3)).astype(np.float32), (0, 0), 2)
    photo = noise.astype(np.uint8)
    data = compressed(photo)
    again = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert again is not None
    assert len(data) < photo.size / 4
    assert 0 < np.abs(again[..., ::-1].astype(int) - photo).mean() < 5


def automatic(errors: Errors, camera_sees: np.ndarray) -> list[Exposure]:
    return automatics(camera_sees, np.linspace(0, 18, len(camera_sees)), errors, np.random.default_rng(3))[0]


def test_automatic_exposure_follows_the_light_late_and_the_shutter_with_it() -> None:
    sees = np.full((60, 3), 0.2)
    sees[30:] = 0.6
    gains = np.array([taken.gain for taken in automatic(Errors(), sees)])
    # A third of the light: all but the share that is not followed is given back, not at once.
    assert np.log(gains[:25].mean() / gains[40:].mean()) == pytest.approx(0.75 * np.log(3), abs=0.15)
    assert gains[30] > gains[32] > gains[40] * 0.9
    times = np.array([taken.seconds for taken in automatic(Errors(), sees)])
    assert np.allclose(times**2 / gains, times[0] ** 2 / gains[0])
    fixed = automatic(dataclasses.replace(Errors(), exposure=False), sees)
    assert len({(taken.gain, taken.seconds) for taken in fixed}) == 1


def test_white_balance_takes_away_a_part_of_the_picture_s_color_and_wanders() -> None:
    sees = np.full((60, 3), 0.3)
    sees[30:, 0] = 0.6
    red = np.log([taken.balance[0] for taken in automatic(Errors(), sees)])
    assert red[:25].mean() - red[40:].mean() == pytest.approx(module.BALANCE_STRENGTH * np.log(2), abs=0.1)
    assert red[:25].std() > 0.003
    assert {taken.balance for taken in automatic(only("exposure"), sees)} == {(1.0, 1.0, 1.0)}


def test_exposure_and_blur_are_switched_apart() -> None:
    sees = np.random.default_rng(0).uniform(0.1, 0.5, (20, 3))
    assert {taken.seconds for taken in automatic(only("exposure"), sees)} == {0.0}
    assert {taken.seconds for taken in automatic(only("blur"), sees)} == {module.SHUTTER}
    ours, theirs = automatic(only("exposure"), sees), automatic(Errors(), sees)
    assert [taken.gain for taken in ours] == [taken.gain for taken in theirs]


def test_what_lies_behind_the_camera_stays_there(wall: DrawnScene) -> None:
    path = passing(3.0)
    away = dataclasses.replace(path, targets=path.places - np.array([0.0, 1.0, 0.0]))
    light = expose(wall, away, CAMERA, Exposure(0.0, 0.02, 1.0), Errors())
    assert np.allclose(light, module.BACKDROP)
