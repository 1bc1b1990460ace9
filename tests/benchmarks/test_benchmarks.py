"""The benchmarks at their smallest: what they write, and that they go on where they stopped."""

from __future__ import annotations

import copy
import dataclasses
import json
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import agreement
import compiled
import cv2
import discriminator
import game
import harness
import learning
import losses
import numpy as np
import paper
import parts
import probes
import pytest
import real_errors
import recipes
import scans
import sparsity
import study
import torch

import examples
from advtex_engine.adversarial.discriminator import PatchDiscriminator
from advtex_engine.adversarial.optimizer import AdversarialOptimizer
from advtex_engine.core.config import TextureConfig
from advtex_engine.methods import gabor
from advtex_engine.metrics.lpips import NETWORKS, load_lpips
from advtex_engine.synthetic import patches
from advtex_engine.synthetic.real import drawn_scene
from advtex_engine.synthetic.scan import synthesize

SMALL = ["--views", "6", "--size", "64x64", "--steps", "2", "--faces", "600", "--device", "cpu"]


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """LPIPS with random weights: a number of the right kind, without a download."""
    folder = tmp_path_factory.mktemp("weights")
    generator = torch.Generator().manual_seed(0)
    table, heads = {}, {}
    for layer in NETWORKS["alexnet"]:
        shape = (layer.outputs, layer.inputs, layer.kernel, layer.kernel)
        table[f"features.{layer.number}.weight"] = 0.05 * torch.randn(shape, generator=generator)
        table[f"features.{layer.number}.bias"] = torch.zeros(layer.outputs)
    for index, layer in enumerate(NETWORKS["alexnet"]):
        heads[f"lin{index}.model.1.weight"] = torch.full((1, layer.outputs, 1, 1), 0.01)
    torch.save(table, folder / "alexnet-owt-7be5be79.pth")
    torch.save(heads, folder / "alex.pth")
    return folder


@pytest.fixture(scope="module", autouse=True)
def _few_held_out() -> Iterator[None]:
    """Synthetic scans have as many true views to be scored against as the one that is shown needs."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("advtex_engine.synthetic.scan.HELDOUT_VIEWS", harness.SHOWN_VIEW + 1)
        yield


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scan for all that only read it: 18 views, enough to hold every eighth out and to have pairs of the others."""
    folder = tmp_path_factory.mktemp("scan") / "desk"
    synthesize(folder, views=18, width=96, height=64)
    return folder


@pytest.fixture(scope="module")
def small_desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same of 6 views."""
    folder = tmp_path_factory.mktemp("small-scan") / "desk"
    synthesize(folder, views=6, width=96, height=64)
    return folder


@pytest.fixture
def unrefined(monkeypatch: pytest.MonkeyPatch) -> None:
    """Scans for `learning` with the errors that they have, and small meshes: nothing is asked of how they are made."""
    monkeypatch.setattr(learning, "TextureConfig", partial(TextureConfig, refine=False))
    monkeypatch.setattr(learning, "SCAN_FACES", 600)


def test_results_survive_and_cells_are_found_by_all_their_settings(tmp_path: Path) -> None:
    results = harness.Results(tmp_path / "new" / "results.json")
    results.add({"method": "mean", "level": 1.0}, {"lpips": 0.5}, 2.0)
    results.add({"method": "mean", "level": 2.0}, {"lpips": 0.7}, 2.0)
    again = harness.Results(tmp_path / "new" / "results.json")
    found = again.find({"level": 2.0, "method": "mean"})
    assert found is not None
    assert found["scores"] == {"lpips": 0.7}
    assert again.find({"method": "mean"}) is None
    assert harness.mean_of(again.cells, "lpips") == pytest.approx(0.6)
    again.add({"level": 2.0, "method": "mean"}, {"lpips": 0.3}, 2.0)
    assert harness.mean_of(again.cells, "lpips") == pytest.approx(0.4), "a cell that is made anew takes the place"


def test_a_page_says_when_and_how_it_was_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["/somewhere/tests/benchmarks/study.py", "--levels", "1", "--results", "a b"])
    results = harness.Results(tmp_path / "results.json")
    results.add({"method": "mean"}, {"lpips": 0.25}, 3600.0)
    table = harness.markdown_table(["method", "LPIPS", "objects"], [["mean", 0.25, 3]])
    harness.write_report(tmp_path / "page.md", "A study", results.cells, table)
    page = (tmp_path / "page.md").read_text()
    assert "    python tests/benchmarks/study.py --levels 1 --results 'a b'\n" in page
    assert results.cells[0]["date"] in page
    assert "1.00 hours" in page
    assert page.endswith("| method | LPIPS | objects |\n| --- | --- | --- |\n| mean | 0.250 | 3 |\n")


def test_scans_are_put_together_by_geometric_means() -> None:
    def cell(lpips: float, cost: float) -> dict[str, Any]:
        return {"scores": {"lpips": lpips, "lpips_corrected": lpips / 2, "displacement_cost": cost}}

    lines = {"mean": [cell(0.1, 0.01), cell(0.4, -0.01)], "l1": [cell(0.1, 0.01), None]}
    table = harness.geometric_means("method", lines)
    assert "## Geometric mean over 2 scans" in table
    assert "| method | LPIPS | corrected LPIPS | of it displacement |" in table
    assert "| mean | 0.200 | 0.100 | - | - |" in table
    assert "| l1 |" not in table
    assert harness.geometric_means("method", {"mean": [cell(0.1, 0.01)]}) == ""


@pytest.mark.usefixtures("unrefined")
def test_every_way_to_learn_is_tried(
    desk: Path, tmp_path: Path, weights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ADVTEX_LPIPS_WEIGHTS", str(weights))
    line = [str(desk), "--scan-size", "96x64", "--steps", "10", "--device", "cpu"]
    for seeds in ("1", "1"):  # the second time nothing is missing
        learning.main([*line, "--seeds", seeds, "--results", str(tmp_path / "out")])
    cells = json.loads((tmp_path / "out" / "learning.json").read_text())["cells"]
    assert [cell["settings"]["option"] for cell in cells] == list(learning.OPTIONS)
    # Views as small as these are not aligned, and of a view's few pairs each is in the nearest half.
    assert len({cell["scores"]["margin 1"] for cell in cells}) == len(cells) - 2, "each is an option of its own"
    page = (tmp_path / "out" / "learning.md").read_text()
    assert all(f"| {option} |" in page for option in learning.OPTIONS)


@pytest.mark.usefixtures("unrefined")
def test_what_is_learned_elsewhere_is_asked_of_a_scan_that_was_not_seen(
    desk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(learning, "DRAWS", 60)
    scans = [desk, tmp_path / "shelf", tmp_path / "room"]
    for error, scan in zip((0.005, 0.01), scans[1:], strict=True):
        synthesize(scan, views=18, width=96, height=64, camera_error=error)  # one object is built once
    line = [*map(str, scans), "--scan-size", "96x64", "--steps", "12", "--device", "cpu", "--options", "both"]
    learning.main([*line, "--elsewhere", "--results", str(tmp_path / "out")])
    cells = json.loads((tmp_path / "out" / "learning.json").read_text())["cells"]
    assert [cell["settings"]["learned_on"] for cell in cells] == ["room shelf", "desk room", "desk shelf"]
    assert all(0.3 < cell["scores"]["accuracy 1"] < 0.7 for cell in cells)
    # Few steps leave all logits on one side of 0, where half are right whatever they are; about their mean it shows,
    # where the means of real and false logits are a tenth of their spread apart.
    clear = [scores for cell in cells if abs((scores := cell["scores"])["margin 1"]) > 0.1 * scores["spread 1"]]
    assert len(clear) == len(cells)
    assert all((scores[learning.CENTERED] > 0.5) == (scores["margin 1"] > 0) for scores in clear)
    centered, as_it_is = (
        sum(abs(cell["scores"][name] - 0.5) for cell in cells) for name in (learning.CENTERED, "accuracy 1")
    )
    assert centered > as_it_is
    page = (tmp_path / "out" / "learning.md").read_text()
    assert "## Learned on all other scans" in page
    assert "| both, centered |" in page


def test_a_normalized_convolution_has_no_gain_above_one() -> None:
    network = learning.Spectral(torch.Generator().manual_seed(0))
    with torch.no_grad():
        network.convolutions[0].weight *= 50  # type: ignore[operator,union-attr]
    x = torch.rand(1, 6, 64, 64)
    for _ in range(30):
        small, _ = network.examine(x)
        large, _ = network.examine(x, [10 * p if p.dim() > 1 else p for p in network.parameters()])
    assert torch.allclose(small, large, rtol=0.02, atol=1e-5)


def test_mirrored_examples_keep_the_places_of_their_patches() -> None:
    network = learning.Augmented(torch.Generator().manual_seed(0))
    x = torch.zeros(1, 6, 96, 128)
    x[:, :, 40:48, 16:24] = 1.0
    torch.manual_seed(0)
    for _ in range(6):
        logits, _ = network.examine(x)
        off = (logits - logits[0, 0, -1, -1]).abs()[0, 0]
        row, column = divmod(int(off.argmax()), off.shape[1])
        assert abs(12 + 8 * row - 44) <= 24 and abs(12 + 8 * column - 20) <= 24


@pytest.mark.slow
def test_the_study_makes_a_table_and_does_nothing_twice(
    tmp_path: Path, weights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    line = [*SMALL, "--models", "1", "--levels", "1", "--lpips-weights", str(weights), "--results", str(tmp_path)]
    line += ["--errors", "cameras", "--methods", "mean", "colormap", "adversarial_no_condition"]
    study.main(line)
    found = json.loads((tmp_path / "study.json").read_text())["cells"]
    assert len(found) == 3
    assert {cell["settings"]["refined"] for cell in found if cell["settings"]["method"] == "colormap"} == {True}
    assert {cell["settings"]["turn"] for cell in found} == {5.0}
    for cell in found:
        assert set(cell["scores"]) == set(harness.SCORES)
        assert cell["scores"]["lpips"] > 0
    page = (tmp_path / "study.md").read_text()
    assert page.count("| colormap |") == 1
    assert (tmp_path / "study.png").stat().st_size > 1000

    monkeypatch.setattr(study, "synthesize", lambda *_, **__: pytest.fail("every cell is there already"))
    study.main(line)


def test_the_errors_of_the_study_are_the_paper_s(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    asked: list[dict[str, Any]] = []
    monkeypatch.setattr(study, "synthesize", lambda _folder, **options: asked.append(options))
    arguments = study.arguments_of(["--models", "1", "--levels", "1", "4.5", "--methods", "mean"])
    for cell in study.cells(arguments):
        study.make_scan(tmp_path, cell)
    told = [(one["camera_error"], one["camera_turn"], one["geometry_error"]) for one in asked]
    five = 5 * 3.14159265 / 180
    assert told == [
        pytest.approx((0.3 * 0.015, five, 0)),
        pytest.approx((0.3 * 0.01 * 1.5**4.5, five, 0)),
        pytest.approx((0, 0, 0.3 * 0.03)),
        pytest.approx((0, 0, 0.3 * 0.02 * 1.5**4.5)),
    ]


@pytest.mark.slow
def test_cameras_that_are_turned_agree_less(tmp_path: Path, weights: Path) -> None:
    """And what the descent would do is told on either side of its limit."""
    line = [*SMALL, "--turns", "0.3", "25", "--levels", "--lpips-weights", str(weights), "--results", str(tmp_path)]
    agreement.main(line)
    exact, wrong = (cell["scores"] for cell in json.loads((tmp_path / "agreement.json").read_text())["cells"])
    assert exact["unlike"] < gabor.UNLIKE < wrong["unlike"]
    assert all(scores["end"] != scores["start"] for scores in (exact, wrong))
    assert "| cameras | 25 degrees | as they came |" in (tmp_path / "agreement.md").read_text()


@pytest.mark.slow
def test_sparsity_takes_every_so_many_views(tmp_path: Path, weights: Path) -> None:
    line = [*SMALL, "--every", "1", "2", "--methods", "mean", "view_selection"]
    sparsity.main([*line, "--lpips-weights", str(weights), "--results", str(tmp_path)])
    found = json.loads((tmp_path / "sparsity.json").read_text())["cells"]
    views = {(cell["settings"]["method"], cell["settings"]["every"]): cell["scores"]["used_views"] for cell in found}
    assert views == {(method, every): 6 / every for method in ("mean", "view_selection") for every in (1, 2)}
    assert "| mean | 3 |" in (tmp_path / "sparsity.md").read_text()
    assert (tmp_path / "sparsity.png").exists()


@pytest.mark.slow
def test_every_option_of_the_discriminator_runs(tmp_path: Path, weights: Path) -> None:
    discriminator.main([*SMALL, "--lpips-weights", str(weights), "--results", str(tmp_path)])
    page = (tmp_path / "discriminator.md").read_text()
    assert all(f"| {option} |" in page for option in discriminator.OPTIONS)


@pytest.mark.parametrize("patch", sorted(discriminator.PATCHES))
def test_patches_have_their_size_and_the_common_centers(patch: int) -> None:
    """By the pixels that a logit's gradient reaches."""
    network = discriminator.discriminator(patch, 0)
    condition = torch.zeros((1, 3, 192, 240), requires_grad=True)
    logits = network(condition, torch.zeros_like(condition))
    assert logits.shape == PatchDiscriminator()(condition, condition).shape
    row, column = 10, 14
    (gradient,) = torch.autograd.grad(logits[0, 0, row, column], [condition])
    reached = gradient[0].abs().sum(0) > 0
    rows, columns = reached.any(1).nonzero()[:, 0], reached.any(0).nonzero()[:, 0]
    assert len(rows) == len(columns) == patch
    middle = 12 + 8 * torch.tensor([row, column])
    assert (rows[0] + rows[-1] + 1).item() == 2 * middle[0].item()
    assert (columns[0] + columns[-1] + 1).item() == 2 * middle[1].item()


def test_a_benchmark_without_weights_ends_with_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="no weights"):
        sparsity.main([*SMALL, "--lpips-weights", str(tmp_path), "--results", str(tmp_path)])


def test_parts_switch_off_what_is_there() -> None:
    for variant in parts.VARIANTS.values():
        with parts.patched(variant.prepared), parts.patched(variant.code):
            pass
    with pytest.raises(AttributeError), parts.patched({"advtex_engine.refine.run.NO_SUCH_NAME": 0}):
        pass


@pytest.mark.slow
def test_each_part_is_switched_off_once(
    small_desk: Path, tmp_path: Path, weights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(parts, "HOLDOUT", 3)
    some = (*parts.SHOWN, "no descent, without a lens")
    monkeypatch.setattr(parts, "VARIANTS", {name: parts.VARIANTS[name] for name in some})
    line = [str(small_desk), *SMALL, "--synthetic", "geometry", "--models", "1", "--lpips-weights", str(weights)]
    line += ["--results", str(tmp_path), "--scan-faces", "600"]
    parts.main(line)
    page = (tmp_path / "parts.md").read_text()
    assert all(page.count(f"| {variant} |") == 2 for variant in parts.VARIANTS)
    assert (tmp_path / "geometry_0.png").stat().st_size > 1000
    assert (tmp_path / "desk" / "the_whole" / "sheet.png").stat().st_size > 1000

    monkeypatch.setattr(parts, "prepare", lambda *_: pytest.fail("every cell is there already"))
    parts.main(line)


@pytest.mark.slow
def test_methods_are_compared_on_a_scan(
    small_desk: Path, tmp_path: Path, weights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    line = [str(small_desk), "--size", "96x64", "--holdout", "3", "--steps", "2", "--device", "cpu"]
    line += ["--methods", "mean", "view_selection", "--lpips-weights", str(weights), "--results", str(tmp_path / "out")]
    scans.main(line)
    found = json.loads((tmp_path / "out" / "scans.json").read_text())["cells"]
    assert {(cell["settings"]["method"], cell["scores"]["heldout_views"]) for cell in found} == {
        ("mean", 2.0),
        ("view_selection", 2.0),
    }
    for cell in found:
        assert {"lpips", "lpips_corrected", "displacement_cost", "displacement_pixels", "motion_cost"} <= set(
            cell["scores"]
        )
    page = (tmp_path / "out" / "scans.md").read_text()
    assert "| method | LPIPS | corrected LPIPS | of it displacement | displacement, pixels |" in page
    assert all(f"| {method} |" in page for method in ("mean", "view_selection"))
    assert (tmp_path / "out" / "desk" / "mean" / "sheet.png").stat().st_size > 1000

    monkeypatch.setattr(scans, "prepare", lambda *_: pytest.fail("every cell is there already"))
    scans.main(line)


def test_compiled_steps_are_timed_beside_the_plain_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(_: object) -> None:
        raise RuntimeError("no compiler\nand more")

    def cannot(optimizer: Any) -> None:
        optimizer.play = broken

    monkeypatch.setattr(compiled, "FORMS", {"nothing": compiled.FORMS["nothing"], "play": cannot})
    monkeypatch.setattr(compiled, "FACES", 600)
    monkeypatch.setattr(compiled, "VIEWS", 4)
    line = ["--device", "cpu", "--sizes", "96x72", "--presets", "paper", "--results", str(tmp_path)]
    compiled.main(line)
    rows = [
        row.split(" | ") for row in (tmp_path / "compiled.md").read_text().splitlines() if row.startswith("| 96x72")
    ]
    assert [row[2] for row in rows] == ["nothing", "play"]
    assert rows[0][-1] == "1.00 |"
    assert float(rows[0][4]) >= float(rows[0][5]) > 0
    assert rows[1][3] == "failed: no compiler"


@pytest.mark.slow
def test_the_paper_s_method_stands_beside_its_peers_and_its_suspects(
    small_desk: Path, tmp_path: Path, weights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in {"SIZE": "64x64", "VIEWS": 6, "FACES": 600, "SCAN_FACES": 600, "HOLDOUT": 3}.items():
        monkeypatch.setattr(paper, name, value)
    line = [str(small_desk), "--scan-size", "96x64", "--errors", "geometry", "--levels", "1", "--steps", "2"]
    coded = [f"from the mean, {how}" for how in ("a tenth of theta_z", "fake without holes")]
    changed = ["from the mean", *coded]
    line += ["--rows", "l1", "view_selection_no_descent", "adversarial", *changed, "--device", "cpu"]
    line += ["--lpips-weights", str(weights), "--results", str(tmp_path / "out")]
    paper.main(line)
    found = json.loads((tmp_path / "out" / "paper.json").read_text())["cells"]
    assert len(found) == 12
    ends = {cell["settings"]["row"]: cell["scores"]["lpips"] for cell in found if cell["settings"]["scan"] == "desk"}
    assert all(ends[row] != ends["from the mean"] for row in coded)
    assert all(0 <= cell["scores"]["speckle"] < 1 for cell in found)
    page = (tmp_path / "out" / "paper.md").read_text()
    assert page.count("| l1 | - |") == page.count("| adversarial | 2 |") == 2
    for name in ("geometry_1_64x64", "desk_96x64"):
        shown = ("photograph", "l1", "view_selection_no_descent", "adversarial")
        pictures = {row: f"pictures/{name}_{row}.jpg" for row in shown}
        assert all(f"![{row}]({path})" in page for row, path in pictures.items())
        photograph, *renders = (cv2.imread(str(tmp_path / "out" / path)) for path in pictures.values())
        for render in renders:
            assert render.shape == photograph.shape and np.corrcoef(render.ravel(), photograph.ravel())[0, 1] > 0.5

    monkeypatch.setattr(paper, "prepare", lambda *_: pytest.fail("every cell is there already"))
    paper.main(line)


@pytest.mark.slow
def test_the_game_ends_where_the_run_ends(
    small_desk: Path, tmp_path: Path, weights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (paper, game):
        for name, value in {"SIZE": "64x64", "VIEWS": 6, "FACES": 600, "SCAN_FACES": 600, "HOLDOUT": 3}.items():
            monkeypatch.setattr(module, name, value)
    line = [str(small_desk), "--scan-size", "96x64", "--errors", "--steps", "4"]
    line += ["--device", "cpu", "--lpips-weights", str(weights)]
    paper.main([*line, "--rows", "adversarial", "--results", str(tmp_path / "paper")])
    changed = ["--change", "start=selection", "lr_texture=1e-2"]
    for change in ([], changed):
        game.main([*line, "--points", "2", *change, "--results", str(tmp_path / "game")])
    readings = json.loads((tmp_path / "game" / "game.json").read_text())["cells"]
    assert [cell["settings"]["step"] for cell in readings] == [0, 1, 2, 3, 4] * 2
    for cell in readings:
        assert ({"gradient_adversarial", "gradient_l1"} <= set(cell["scores"])) == (cell["settings"]["step"] > 0)
    assert {"accuracy_real", "accuracy_fake", "margin", "spread"} <= set(readings[9]["scores"])
    cells = [cell for cell in readings if "lpips" in cell["scores"]]
    assert [cell["settings"]["step"] for cell in cells] == [0, 2, 4] * 2
    assert (tmp_path / "game" / "game.png").stat().st_size > 1000
    usual = [cell for cell in cells if not cell["settings"]["changes"]]
    assert [cell["scores"]["lpips"] for cell in usual] != [cell["scores"]["lpips"] for cell in cells[3:]]
    ends = {cell["settings"]["scan"]: cell["scores"] for cell in usual if cell["settings"]["step"] == 4}
    for cell in json.loads((tmp_path / "paper" / "paper.json").read_text())["cells"]:
        assert ends[cell["settings"]["scan"]]["lpips"] == pytest.approx(cell["scores"]["lpips"], abs=1e-6)
    page = (tmp_path / "game" / "game.md").read_text()
    assert "## desk, 96x64, paper, 4 steps, start=selection lr_texture=1e-2" in page
    with pytest.raises(SystemExit, match="--change rate: the preset has no such number"):
        game.main([*line, "--change", "rate=1", "--results", str(tmp_path / "game")])


def test_the_state_that_is_kept_is_the_best_before_patience_is_over() -> None:
    assert probes.kept_state([0, 1, 3, 2, 4], 2) == (4, 4)
    assert probes.kept_state([0, 1, 3, 2, 1, 9], 2) == (2, 4)
    assert probes.kept_state([0, -1, -2, 9], 2) == (0, 2)
    assert probes.rank_correlation([1, 2, 3, 4], [10, 20, 50, 90]) == pytest.approx(1)
    assert probes.rank_correlation([1, 2, 2, 4], [8, 6, 6, 1]) == pytest.approx(-1)
    assert probes.ranks([5, 1, 5, 9]) == [2.5, 1, 2.5, 4]
    settings = {"preset": "standard", "steps": 1500}
    assert [probes.patience_of({**settings, "turn": turn}) for turn in (40, 60, 120, 500)] == [3, 2, 1, 1]


@pytest.mark.slow
def test_probes_stand_beside_views_that_a_run_never_sees(desk: Path, tmp_path: Path, weights: Path) -> None:
    line = [str(desk), "--synthetic", "geometry", "--views", "8", "--scan-size", "96x64", "--faces", "600"]
    line += ["--steps", "8", "--turn", "3", "--no-refine", "--device", "cpu"]
    probes.main([*line, "--lpips-weights", str(weights), "--results", str(tmp_path / "out")])
    cells = json.loads((tmp_path / "out" / "probes.json").read_text())["cells"]
    assert [(cell["settings"]["scan"], cell["settings"]["step"]) for cell in cells] == [
        (scan, step) for scan in ("geometry", "desk") for step in (0, 3, 6, 8)
    ]
    for cell in cells:
        gains = [cell["scores"][f"gain_{name}"] for name in probes.MEASURES]
        assert (gains == [0, 0]) == (cell["settings"]["step"] == 0)
        assert cell["scores"]["lpips"] > 0
    page = (tmp_path / "out" / "probes.md").read_text()
    assert "## desk, 96x64, standard, 8 steps in turns of 3, seed 0, cameras as they are" in page


def test_losses_are_compared_one_by_one(
    desk: Path, tmp_path: Path, weights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(losses, "load_lpips", lambda folder, *_: load_lpips(folder))  # VGG16 takes long
    before = dict(vars(losses.gabor))
    line = [str(desk), "--scan-size", "96x64", "--faces", "600", "--steps", "4", "--device", "cpu"]
    line += ["--no-refine"]
    names = ["start", "l1", "ssim", "untrained discriminator", "lpips", "gabor", "no maximum", "4 orientations"]
    for _ in range(2):  # the second time nothing is missing
        losses.main([*line, "--losses", *names, "--lpips-weights", str(weights), "--results", str(tmp_path / "out")])
    cells = json.loads((tmp_path / "out" / "losses.json").read_text())["cells"]
    assert [cell["settings"]["loss"] for cell in cells] == names
    scores = {(cell["scores"]["lpips"], cell["scores"]["psnr"]) for cell in cells}
    assert len(scores) == len(names), "each is a loss of its own"
    for found in (cell["scores"] for cell in cells):
        assert found["lpips_vgg16"] == pytest.approx(found["lpips_corrected"], abs=1e-4), "the same ruler here"
    assert vars(losses.gabor) == before
    assert "## desk, 96x64, 4 steps, cameras as they are" in (tmp_path / "out" / "losses.md").read_text()


def test_recipes_are_played_one_by_one(
    desk: Path, tmp_path: Path, weights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recipes, "TextureConfig", partial(TextureConfig, refine=False))
    monkeypatch.setattr(recipes, "SCAN_FACES", 600)
    names = ["no descent", "view selection", "as it is", "wide means compared", "awake", "awake, two scales"]
    names += ["awake, four crops a step", "awake, the source itself, displaced"]
    line = [str(desk), "--size", "96x64", "--steps", "6", "--device", "cpu", "--recipes", *names]
    for _ in range(2):  # the second time nothing is missing
        recipes.main([*line, "--lpips-weights", str(weights), "--results", str(tmp_path / "out")])
    cells = json.loads((tmp_path / "out" / "recipes.json").read_text())["cells"]
    assert [cell["settings"]["recipe"] for cell in cells] == names
    assert len({cell["scores"]["psnr"] for cell in cells}) == len(cells), "each is a recipe of its own"
    told = {cell["settings"]["recipe"]: "told apart, end" in cell["scores"] for cell in cells}
    assert told == {name: recipes.RECIPES[name].method == "adversarial" for name in names}
    page = (tmp_path / "out" / "recipes.md").read_text()
    assert all(f"| {name} |" in page for name in names)


def test_a_recipe_begins_with_what_was_learned_on_other_scans(
    desk: Path, tmp_path: Path, weights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recipes, "TextureConfig", partial(TextureConfig, refine=False))
    monkeypatch.setattr(recipes, "SCAN_FACES", 600)
    monkeypatch.setattr(recipes, "ELSEWHERE_SIZE", "96x64")
    learned = list[tuple[int, Any]]()
    learn = recipes.learned_on

    def noted(givens: Sequence[Any], *rest: Any) -> Any:
        optimizer = learn(givens, *rest)
        learned.append((len(givens), optimizer.discriminator))
        return optimizer

    monkeypatch.setattr(recipes, "learned_on", noted)
    begun = list[Any]()

    def with_it(*given: Any, discriminator: Any, **other: Any) -> Any:
        begun.append(copy.deepcopy(discriminator))
        return AdversarialOptimizer(*given, discriminator=discriminator, **other)

    monkeypatch.setattr(f"{recipes.GAME}.AdversarialOptimizer", with_it)
    (tmp_path / "room").symlink_to(desk)
    line = [str(desk), "--size", "96x64", "--steps", "6", "--device", "cpu", "--recipes", recipes.ELSEWHERE]
    line += ["--lpips-weights", str(weights), "--results", str(tmp_path / "out")]
    with pytest.raises(SystemExit):
        recipes.main(line)
    recipes.main([*line, "--elsewhere", str(tmp_path / "room"), str(desk), "--elsewhere-steps", "3"])
    [(scans, discriminator)], [first] = learned, begun
    assert scans == 1, "the scan itself is left out"
    for values, of_start in zip(discriminator.parameters(), first.parameters(), strict=True):
        assert torch.equal(values, of_start)
    assert f"| {recipes.ELSEWHERE} |" in (tmp_path / "out" / "recipes.md").read_text()


def test_blurred_photographs_are_left_out_of_the_sharper_half(desk: Path, tmp_path: Path) -> None:
    config = TextureConfig(preset="standard", size=(96, 64), refine=False, face_budget=600, device="cpu")
    given = harness.prepare(desk, config, tmp_path, torch.device("cpu"))
    widely = dataclasses.replace(given.preset, max_pair_angle=60.0, min_pair_overlap=0.1)
    given, maps = dataclasses.replace(given, preset=widely), given.maps[1]
    blurred = list(range(0, maps.count, 3))
    for view in blurred:
        color = maps.color[view].view(maps.height, maps.width, 3)
        color.copy_(torch.from_numpy(cv2.GaussianBlur(color.numpy(), (0, 0), 3)))
    before, after = recipes.pairs_of(given, maps), recipes.sharper_pairs(given, maps)
    shown = [set(after.auxiliary[view, 1 : after.count[view]].tolist()) for view in range(maps.count)]
    offered = [set(before.auxiliary[view, 1 : before.count[view]].tolist()) for view in range(maps.count)]
    assert max(map(len, offered)) > 3
    for view, (kept, all_of_them) in enumerate(zip(shown, offered, strict=True)):
        assert after.auxiliary[view, 0] == view, "the source itself stays"
        assert kept <= all_of_them
        assert len(kept) == (len(all_of_them) + 1) // 2
        assert not kept & set(blurred) or all_of_them - set(blurred) <= kept, "a sharp one goes before a blurred one"


@pytest.mark.slow
def test_real_examples_are_as_far_from_their_sources_as_the_scan_s_errors(
    tmp_path: Path, weights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(examples, "LEAST_PIXELS", 500)
    monkeypatch.setattr(examples, "SCAN_FACES", 2000)
    for name, error in (("exact", 0.0), ("off", 0.02)):
        synthesize(tmp_path / name, views=18, width=96, height=72, camera_error=error, geometry_error=0.0)
    line = [str(tmp_path / "exact"), str(tmp_path / "off"), "--scan-size", "96x72", "--errors", "--pairs", "8"]
    line += ["--device", "cpu", "--lpips-weights", str(weights), "--results", str(tmp_path / "out")]
    examples.main(line)
    cells = json.loads((tmp_path / "out" / "examples.json").read_text())["cells"]
    exact, off = (cell["scores"] for cell in cells)
    assert exact["pairs"] == off["pairs"] == 8
    assert exact["real lpips"] < 0.5 * off["real lpips"]
    assert exact["l1 lpips"] < off["l1 lpips"]
    page = (tmp_path / "out" / "examples.md").read_text()
    assert "| exact | 96x72 |" in page
    assert "| off | 96x72 |" in page


@pytest.mark.slow
def test_real_errors_make_a_table_and_do_nothing_twice(
    tmp_path: Path, weights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn_scene.cache_clear()
    monkeypatch.setattr(patches, "LIGHTS", 4)
    line = [*SMALL, "--scenes", "object", "--errors", "none", "drift", "--methods", "mean"]
    line += ["--lpips-weights", str(weights), "--results", str(tmp_path)]
    real_errors.main(line)
    cells = harness.Results(tmp_path / "real_errors.json").cells
    found = {cell["settings"]["errors"]: cell["scores"] for cell in cells}
    assert found["none"]["lpips"] == found["none"]["lpips_tracked"]
    assert found["drift"]["lpips"] != found["drift"]["lpips_tracked"]
    page = (tmp_path / "real_errors.md").read_text()
    assert page.index("| none |") < page.index("| drift |")
    monkeypatch.setattr(real_errors, "synthesize_real", None)
    real_errors.main(line)
    drawn_scene.cache_clear()
