"""A game that is probed: it ends where it cannot help, exactly as it began, and goes on where it was interrupted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from advtex_engine.core.config import PRESETS, Preset, PyramidLevel, TextureConfig, resolve_preset
from advtex_engine.core.errors import Stopped
from advtex_engine.core.monitor import Monitor
from advtex_engine.core.scene import Atlas, Camera, Mesh, Scene, View
from advtex_engine.methods import MethodInput
from advtex_engine.methods.adversarial import adversarial
from advtex_engine.methods.mean import mean_texture
from advtex_engine.metrics.lpips import WEIGHTS_VARIABLE
from advtex_engine.previews.live import Live
from advtex_engine.render.view_maps import ViewMaps
from advtex_engine.runtime.checkpoint import WorkFolder
from advtex_engine.synthetic.planar import planar_maps

SIZE, VIEWS, STEPS = 48, 7, 100
PRETRAINING, TURN = 10, 10
PRESET = replace(
    PRESETS["standard"],
    levels=(PyramidLevel(STEPS),),
    pretraining=PRETRAINING,
    averaging=40,
    turn=TURN,
    max_crop=(24, 24),
    alignment=False,
    areas=False,  # a texel per pixel: the picture is exact
)


@pytest.fixture(autouse=True)
def no_weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(WEIGHTS_VARIABLE, str(tmp_path / "nothing"))


class Listener(Monitor):
    """Stops once, when a step is reached."""

    def __init__(self, stop_at: int | None = None) -> None:
        self.stop_at = stop_at
        self.steps, self.notes = list[tuple[int, int]](), list[str]()

    def progress(self, step: int, steps: int, losses: Mapping[str, float]) -> None:
        self.steps.append((step, steps))

    def note(self, message: str) -> None:
        self.notes.append(message)

    def stop_requested(self) -> bool:
        return self.stop_at is not None and bool(self.steps) and self.steps[-1][0] >= self.stop_at


def picture() -> Tensor:
    """[SIZE,SIZE,3] in [0,1]: detail of two pixels and more."""
    image = torch.zeros((1, 3, SIZE, SIZE))
    generator = torch.Generator().manual_seed(0)
    for size in (2, 6, 16):
        noise = torch.rand((1, 3, SIZE // size, SIZE // size), generator=generator)
        image += F.interpolate(noise, (SIZE, SIZE), mode="bilinear", align_corners=False)
    return (image[0].permute(1, 2, 0) * 85).to(torch.uint8) / 255


def blurred(image: Tensor) -> Tensor:
    planes = F.avg_pool2d(image.permute(2, 0, 1)[None], 5, 1, 2, count_include_pad=False)
    return planes[0].permute(1, 2, 0)


def planar(size: int = SIZE) -> ViewMaps:
    """Views that all show the picture as it is, a texel per pixel."""
    planes = picture().permute(2, 0, 1)[None]
    planes = F.interpolate(planes, (size, size), mode="bilinear", antialias=True)  # as a start is made smaller
    color = (planes[0].permute(1, 2, 0) * 255).round().to(torch.uint8)
    return planar_maps(color.expand(VIEWS, -1, -1, -1).contiguous(), size, size)


def task(work: Path, start: Tensor, monitor: Monitor | None = None, preset: Preset = PRESET) -> MethodInput:
    """start: [SIZE,SIZE,3]. Its halves count as painted from the first and from the second view."""
    listener = monitor or Listener()
    corners = torch.tensor([[0.0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    atlas = Atlas(Mesh(corners, faces, corners[:, :2].clone(), faces), SIZE, SIZE, "scan", 1)
    K = torch.tensor([[SIZE, 0, SIZE / 2], [0, SIZE, SIZE / 2], [0, 0, 1]], dtype=torch.float64)
    camera = Camera(K, torch.eye(4, dtype=torch.float64), SIZE, SIZE)
    scene = Scene(atlas.mesh, (View("0", camera, (picture() * 255).to(torch.uint8)),))
    maps = {level.scale: planar(SIZE // level.scale) for level in (*preset.levels, PyramidLevel(0))}
    painted = torch.zeros((SIZE, SIZE), dtype=torch.int16)
    painted[:, SIZE // 2 :] = 1
    means = {scale: mean_texture(level) for scale, level in maps.items()}
    folder, live = WorkFolder(work, "", listener), Live(scene, atlas, listener)
    config = TextureConfig(device="cpu")
    return MethodInput(scene, atlas, maps, means, preset, config, listener, folder, live, start=start, painted=painted)


@pytest.fixture(scope="module")
def helped(tmp_path_factory: pytest.TempPathFactory) -> tuple[Tensor, MethodInput]:
    """From a blurred start, with a rate at which it pays: texture and input."""
    with pytest.MonkeyPatch.context() as patch:
        folder = tmp_path_factory.mktemp("helped")
        patch.setenv(WEIGHTS_VARIABLE, str(folder / "nothing"))
        given = task(folder, blurred(picture()), preset=paying())
        texture, _ = adversarial(given)
    return texture, given


def paying() -> Preset:
    """Pulled to the photographs themselves, which are without any error."""
    return replace(PRESET, l1_target="source", l1_weight=100.0, lr_texture=5e-3, lr_end=1.0)


def test_a_start_that_no_step_can_better_is_the_result_bit_for_bit(tmp_path: Path) -> None:
    start, monitor = picture(), Listener()
    given = task(tmp_path, start, monitor, replace(PRESET, lr_texture=1e-2))
    texture, losses = adversarial(given)
    assert torch.equal(texture, start)
    probes = given.facts["game"]["probes"]
    assert (probes["kept"], probes["why"]) == (None, "never better than its start")
    assert probes["ended"] == PRETRAINING + PRESET.patience * TURN == losses[-1]["step"]
    assert all(turn["gain"] < 0 for turn in probes["turns"])
    assert monitor.steps[-1] == (STEPS, STEPS), "nothing is left to wait for"
    assert monitor.steps[-2] == (probes["ended"], STEPS)
    assert monitor.notes == [probes["told"]]


def test_where_it_pays_the_game_goes_on_and_its_best_state_is_kept(helped: tuple[Tensor, MethodInput]) -> None:
    texture, given = helped
    probes = given.facts["game"]["probes"]
    gains = [turn["total"] for turn in probes["turns"]]
    assert probes["ended"] > PRETRAINING + 2 * PRESET.patience * TURN
    assert probes["kept"] == probes["turns"][gains.index(max(gains))]["step"]
    assert max(gains) > 0.1
    before, after = ((each - picture()).abs().mean() for each in (blurred(picture()), texture))
    assert after < 0.9 * before


@pytest.mark.parametrize("stop_at", [PRETRAINING - 3, PRETRAINING + 2 * TURN, PRETRAINING + 3 * TURN + 4])
def test_a_probed_run_that_is_stopped_goes_on_to_the_same_bits(
    tmp_path: Path, helped: tuple[Tensor, MethodInput], stop_at: int
) -> None:
    """Before the first turn, between two turns, and in the middle of one."""
    whole, given = helped
    with pytest.raises(Stopped, match=f"after step {stop_at} of"):
        adversarial(task(tmp_path, blurred(picture()), Listener(stop_at), paying()))
    again = task(tmp_path, blurred(picture()), preset=paying())
    texture, _ = adversarial(again)
    assert torch.equal(texture, whole)
    assert again.facts["game"] == given.facts["game"]


def test_a_run_that_is_stopped_where_it_ends_takes_no_other_step(tmp_path: Path) -> None:
    preset, end = replace(PRESET, lr_texture=1e-2), PRETRAINING + PRESET.patience * TURN
    with pytest.raises(Stopped, match=f"after step {end} of"):
        adversarial(task(tmp_path, picture(), Listener(end), preset))
    monitor = Listener()
    again = task(tmp_path, picture(), monitor, preset)
    texture, _ = adversarial(again)
    assert torch.equal(texture, picture())
    assert monitor.steps == [(STEPS, STEPS)]
    assert again.facts["game"]["probes"]["ended"] == end


def test_a_pyramid_whose_lower_level_brings_nothing_leaves_out_its_top(tmp_path: Path) -> None:
    levels = (PyramidLevel(60, scale=2), PyramidLevel(40))
    monitor = Listener()
    given = task(tmp_path, picture(), monitor, replace(PRESET, levels=levels, lr_texture=1e-2))
    texture, losses = adversarial(given)
    assert torch.equal(texture, picture())
    assert losses[-1]["step"] == PRETRAINING + PRESET.patience * TURN
    assert monitor.steps[-1] == (STEPS, STEPS)


def test_the_levels_of_a_pyramid_are_probed_each_by_itself(tmp_path: Path) -> None:
    levels = (PyramidLevel(40, scale=2), PyramidLevel(60))
    given = task(tmp_path, blurred(picture()), preset=replace(paying(), levels=levels))
    texture, _ = adversarial(given)
    probes = given.facts["game"]["probes"]
    assert {turn["level"] for turn in probes["turns"]} == {1, 2}
    assert [turn["step"] for turn in probes["turns"]][:3] == [20, 30, 40]
    assert probes["turns"][3]["step"] == 50, "its first turn begins with the level"
    assert (texture - picture()).abs().mean() < (blurred(picture()) - picture()).abs().mean()


def test_a_game_without_turns_is_what_it_was(tmp_path: Path) -> None:
    """The paper's, and any that starts from something else: the painters change nothing, and no view is left out."""
    for name, preset in (
        ("paper", replace(PRESETS["paper"], levels=(PyramidLevel(6),))),
        ("none", replace(PRESET, levels=(PyramidLevel(20),))),
    ):
        known = task(tmp_path / name / "a", picture(), preset=preset)
        textures = []
        for given in (
            replace(known, preset=replace(preset, turn=0)),
            replace(known, painted=None, work=WorkFolder(tmp_path / name / "b", "", Monitor())),
        ):
            textures.append(adversarial(given)[0])
            assert given.facts["game"]["probes"] is None
        assert torch.equal(*textures)


def test_a_game_that_cannot_help_has_less_than_a_fifth_of_the_steps() -> None:
    assert PRESETS["paper"].turn == 0
    for name in ("standard", "full", "preview"):
        preset = PRESETS[name]
        # A look costs two steps at most, and there are two to a turn.
        spent = preset.pretraining + preset.patience * (preset.turn + 4)
        costs = sum(level.steps / level.scale**2 for level in preset.levels)
        assert spent / preset.levels[0].scale ** 2 < 0.2 * costs
        half = resolve_preset(TextureConfig(preset=name, steps=preset.steps // 2))
        assert half.turn == preset.turn // 2
