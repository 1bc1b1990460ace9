"""Views left out by turns: what they say of a texture, what is kept of it, and that they take no part."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from advtex_engine.adversarial.discriminator import PatchDiscriminator
from advtex_engine.adversarial.optimizer import AdversarialOptimizer
from advtex_engine.adversarial.probes import CELLS, LEAST_VIEWS, PARTS, LeftOutCells, Probes, Turns, probed
from advtex_engine.adversarial.unlikeness import structure_unlikeness
from advtex_engine.core.config import PRESETS
from advtex_engine.render.motion import smeared
from advtex_engine.render.streaming import ResidentViews
from advtex_engine.render.view_maps import ViewMaps
from advtex_engine.synthetic.planar import planar_maps, planar_pairs

SIZE, VIEWS = 48, 7
CPU = torch.device("cpu")


def picture() -> Tensor:
    """[SIZE,SIZE,3] uint8, with detail of two pixels and more."""
    generator = torch.Generator().manual_seed(0)
    image = torch.zeros((1, 3, SIZE, SIZE))
    for size in (2, 6, 16):
        noise = torch.rand((1, 3, SIZE // size, SIZE // size), generator=generator)
        image += F.interpolate(noise, (SIZE, SIZE), mode="bilinear", align_corners=False)
    return (image[0].permute(1, 2, 0) * 85).to(torch.uint8)


def same_views() -> ViewMaps:
    """All views show one picture, a texel per pixel, and so without any error."""
    return planar_maps(picture().expand(VIEWS, -1, -1, -1).contiguous(), SIZE, SIZE)


def quarters() -> Tensor:
    """[SIZE,SIZE] int16: the start's quarters are painted from views 0 and 1, one from none, one from view 2."""
    painted = torch.zeros((SIZE, SIZE), dtype=torch.int16)
    painted[:24, 24:], painted[24:, :24], painted[24:, 24:] = 1, -1, 2
    return painted


def exact(maps: ViewMaps) -> Tensor:
    return maps.color[0][maps.slot_map.flatten() >= 0].float() / 255


def spoiled(maps: ViewMaps, share: float) -> Tensor:
    noise = torch.randn(exact(maps).shape, generator=torch.Generator().manual_seed(3))
    return exact(maps) + share * 0.1 * noise


def test_only_what_another_view_has_painted_is_judged() -> None:
    maps, painted = same_views(), quarters()
    seen = []

    def measure(renders: Tensor, photographs: Tensor) -> Tensor:
        seen.append((renders, photographs))
        return (renders - photographs).abs().mean(1)

    cells = LeftOutCells(maps, painted, measure)
    values = torch.full((maps.slots, 3), 0.5)
    for view, count in ((0, 2), (1, 2), (5, 3)):
        (one,) = cells.of([view])
        judged = one.judged[0]
        inner = torch.ones((SIZE, SIZE), dtype=torch.bool)
        inner[[0, 23, 24, 47]] = inner[:, [0, 23, 24, 47]] = False  # a footprint may reach beyond its quarter
        allowed = (painted >= 0) & (painted != view)
        assert torch.equal(judged & inner, allowed & inner)
        assert not (judged & ~allowed).any()
        assert int((allowed & inner).sum()) == count * 22**2
        unlike = cells.unlike([one], values)
        shown, photo = seen[-1]
        assert torch.equal(photo[0], picture().permute(2, 0, 1).float() / 255)
        assert torch.equal(shown[0][:, ~judged], photo[0][:, ~judged]), "nothing else is told of"
        by_hand = (picture().float() / 255 - 0.5).abs().mean(2)[judged].mean()
        assert unlike == pytest.approx(float(by_hand), abs=1e-4)


def test_a_soft_texture_is_not_nearer_to_photographs_that_moved() -> None:
    """It is the less like them, the softer it is, and one that is as sharp as what they were taken of is exact."""
    sharp, motion = same_views(), tuple((0, right, 0.2) for right in range(-2, 3))
    moved = smeared(picture().permute(2, 0, 1).float(), motion).permute(1, 2, 0)
    maps = planar_maps(moved.round().to(torch.uint8).expand(VIEWS, -1, -1, -1).contiguous(), SIZE, SIZE)
    soft = maps.color[0][maps.slot_map.flatten() >= 0].float() / 255
    unlike = []
    for motions in (None, dict.fromkeys(range(VIEWS), motion)):
        cells = LeftOutCells(maps, quarters(), structure_unlikeness, motions=motions)
        some = cells.of([0, 1, 5])
        unlike.append([cells.unlike(some, values) for values in (exact(sharp), soft)])
    assert unlike[0][1] < 0.1 * unlike[0][0]
    assert unlike[1][0] < 0.1 * unlike[1][1]


def test_chance_is_how_unlike_unrelated_pictures_are() -> None:
    """Another picture altogether is as unlike as that, the picture itself is not; and by hand."""
    maps = same_views()
    cells = LeftOutCells(maps, quarters(), structure_unlikeness)
    some, noise = cells.of([0, 1, 5]), torch.rand((maps.slots, 3), generator=torch.Generator().manual_seed(1))
    assert cells.unlike(some, exact(maps)) < 0.05 * cells.chance(some, exact(maps))
    assert cells.unlike(some, noise) == pytest.approx(cells.chance(some, noise), rel=0.1)
    (one,) = some[2:]
    turned = torch.where(one.judged[:, None], one.photograph, one.photograph.flip((2, 3)))
    unlike = structure_unlikeness(turned, one.photograph.flip((2, 3)))
    assert cells.chance([one], exact(maps)) == pytest.approx(float(unlike[one.judged].mean()), abs=1e-3)


def test_a_view_that_painted_all_that_it_sees_is_no_judge() -> None:
    maps = same_views()
    cells = LeftOutCells(maps, torch.zeros((SIZE, SIZE), dtype=torch.int16), structure_unlikeness)
    assert cells.of([0]) == []
    assert len(cells.of([0, 1, 2])) == 2


def test_views_of_a_smaller_level_know_their_painters() -> None:
    small = planar_maps(picture()[::2, ::2].expand(VIEWS, -1, -1, -1).contiguous(), SIZE // 2, SIZE // 2)
    (one,) = LeftOutCells(small, quarters(), structure_unlikeness).of([0])
    assert bool(one.judged[0][1:11, 13:23].all())
    assert not bool(one.judged[0][:11, :11].any())
    assert not bool(one.judged[0][13:, :11].any())


def test_cells_are_where_most_can_be_judged_and_a_look_has_no_more_than_its_share() -> None:
    color = torch.zeros((40, 130, 300, 3), dtype=torch.uint8)
    maps = planar_maps(color, 300, 130)
    painted = torch.full((130, 300), -1, dtype=torch.int16)
    painted[:, 200:] = 50
    cells = LeftOutCells(maps, painted, structure_unlikeness)
    (one,) = cells.of([3])
    assert one.judged.shape == (1, 128, 128), "a cell without any pixel is left out"
    assert one.judged[0, :, -99:].all()
    assert sum(len(each.photograph) for each in cells.of(list(range(40)))) <= CELLS


def by_hand(ratios: Sequence[float], patience: int) -> tuple[int | None, int]:
    """The plain twin: the turn whose end is kept, and how many there are."""
    shares = [1.0]
    for ratio in ratios:
        shares.append(shares[-1] * ratio)
        best = shares.index(min(shares))
        if len(shares) - 1 - best >= patience:
            break
    best = shares.index(min(shares))
    return best or None, len(shares) - 1


@pytest.mark.parametrize("patience", [1, 2, 3])
@pytest.mark.parametrize("seed", range(8))
def test_turns_are_counted_as_by_hand(seed: int, patience: int) -> None:
    ratios = (1 + 0.05 * torch.randn(12, generator=torch.Generator().manual_seed(seed))).tolist()
    turns, number = Turns(patience), 0
    while number < len(ratios) and not turns.over:
        number += 1
        better = turns.add(number, 1.0, ratios[number - 1])
        assert better == (turns.kept == number)
    assert (turns.kept, number) == by_hand(ratios, patience)
    whole = 1.0
    for turn, ratio in zip(turns.done, ratios, strict=False):
        whole *= ratio
        assert turn["gain"] == pytest.approx(1 - ratio, abs=1e-4)
        assert turn["total"] == pytest.approx(1 - whole, abs=1e-4)


def probes(maps: ViewMaps, left_out: list[list[int]], **more: int) -> Probes:
    return Probes(
        LeftOutCells(maps, quarters(), structure_unlikeness),
        list(range(VIEWS)),
        lambda views: left_out.append(views.nonzero().flatten().tolist()),
        judged_by="structure",
        start=spoiled(maps, 1.0),
        **{"first": 10, "end": 100, "turn": 20, "patience": 2, **more},  # type: ignore[arg-type]
    )


def test_the_best_state_is_kept_and_not_the_last() -> None:
    maps, left_out = same_views(), list[list[int]]()
    of = probes(maps, left_out)
    assert of.possible
    for step, share in ((10, 1.0), (30, 0.6), (50, 0.4), (70, 0.7)):
        assert of.next == step
        of.reached(step, spoiled(maps, share))
        assert not of.over
    of.reached(90, spoiled(maps, 0.5))
    assert of.over
    assert torch.equal(of.kept, spoiled(maps, 0.4))
    told = probed([of.told], 100)
    assert told is not None
    assert (told["kept"], told["ended"], told["why"], told["judged_by"]) == (50, 90, "no gain in 2 turns", "structure")
    assert [turn["step"] for turn in told["turns"]] == [30, 50, 70, 90]
    assert told["told"] == (
        "The game ended after step 90 of 100, judged by views that were left out of it by turns (structure): no gain in"
        " 2 turns; the texture is that of step 50."
    )
    assert left_out == [[0, 5], [1, 6], [2], [3]], "every view in its turn"


def test_as_long_as_it_pays_the_game_goes_on_to_its_last_step() -> None:
    maps = same_views()
    of = probes(maps, [], end=60)
    for step, share in ((10, 1.0), (30, 0.6), (50, 0.4), (60, 0.3)):
        assert of.next == step
        of.reached(step, spoiled(maps, share))
    of.reached(60, spoiled(maps, 0.3))  # as a run does that goes on where it had ended
    assert (of.over, of.ended) == (False, 60)
    told = probed([of.told], 60)
    assert told is not None
    assert (told["kept"], told["ended"], told["why"], len(told["turns"])) == (60, 60, "all steps taken", 3)
    assert torch.equal(of.kept, spoiled(maps, 0.3))


def test_what_no_turn_makes_better_is_its_start() -> None:
    maps = same_views()
    of = probes(maps, [])
    for step, share in ((10, 1.0), (30, 1.1), (50, 1.2)):
        of.reached(step, spoiled(maps, share))
    assert of.over
    assert torch.equal(of.kept, spoiled(maps, 1.0))
    told = probed([of.told], 100)
    assert told is not None
    assert (told["kept"], told["ended"], told["why"]) == (None, 50, "never better than its start")
    assert told["told"].endswith("the texture is exactly what it began with.")


def test_of_a_pyramid_that_gained_only_below_its_top_the_lower_level_is_kept() -> None:
    levels = [
        {"judged_by": "LPIPS", "ended": 30, "over": True, "patience": 2, "kept": 20, "turns": [{"step": 20}]},
        {"judged_by": "LPIPS", "ended": 95, "over": True, "patience": 2, "kept": None, "turns": [{"step": 95}]},
    ]
    told = probed(levels, 100)
    assert told is not None
    assert (told["kept"], told["ended"], told["why"]) == (20, 95, "no gain in 2 turns")
    assert [turn["level"] for turn in told["turns"]] == [1, 2]
    assert probed([], 100) is None


def test_it_goes_on_in_the_middle_of_a_turn_as_if_it_had_not_been_interrupted() -> None:
    maps = same_views()
    shares = {10: 1.0, 30: 0.6, 50: 0.9, 70: 0.4, 90: 0.5, 100: 0.6}
    whole, left_out = probes(maps, []), list[list[int]]()
    of = probes(maps, left_out)
    for step in range(101):
        for each in (whole, of):
            each.reached(step, spoiled(maps, shares.get(step, 0.0)))
        if step in (0, 35, 50, 83):
            state = of.state_dict()
            of = probes(maps, left_out)
            of.load_state_dict(state, spoiled(maps, 0.0))
            if step >= 10:
                assert left_out[-1] == left_out[-2], "the same views are left out again"
    assert of.state_dict().keys() == whole.state_dict().keys()
    assert torch.equal(of.kept, whole.kept)
    assert of.told == whole.told
    assert (of.told["kept"], of.told["ended"]) == (70, 100)


def test_under_another_measure_a_turn_begins_where_it_goes_on() -> None:
    maps = same_views()
    of = probes(maps, [])
    of.reached(10, spoiled(maps, 1.0))
    other = probes(maps, [])
    other.load_state_dict(of.state_dict() | {"judged_by": "LPIPS", "before": 1e-9}, spoiled(maps, 0.8))
    other.reached(30, spoiled(maps, 0.7))
    assert other.turns.kept == 30
    assert 0 < other.turns.gain < 0.5


def test_too_few_views_and_views_that_judge_nothing_make_no_probe() -> None:
    maps = same_views()

    def of(views: int, painted: Tensor, first: int = 10) -> bool:
        cells = LeftOutCells(maps, painted, structure_unlikeness)
        rest = {"judged_by": "", "start": exact(maps), "end": 100, "turn": 20, "patience": 2}
        return Probes(cells, list(range(views)), lambda _: None, first=first, **rest).possible  # type: ignore[arg-type]

    assert of(LEAST_VIEWS, quarters())
    assert not of(LEAST_VIEWS - 1, quarters())
    assert not of(VIEWS, torch.full((SIZE, SIZE), -1, dtype=torch.int16))
    assert not of(VIEWS, quarters(), first=100)


def test_no_step_of_a_turn_knows_a_view_that_is_left_out() -> None:
    """Black photographs take their place: the texture moves as it would with any others there."""
    maps = same_views()
    color = maps.color.clone()
    color[0::PARTS] = 0
    preset = PRESETS["standard"]
    textures = []
    for shown in (maps, planar_maps(color.view(VIEWS, SIZE, SIZE, 3), SIZE, SIZE)):
        views = ResidentViews(shown, planar_pairs(VIEWS, CPU))
        optimizer = AdversarialOptimizer(
            views.maps,
            views.pairs,
            spoiled(maps, 1.0),
            preset,
            kind="scene",
            steps=preset.steps,
            generator=torch.Generator().manual_seed(0),
            discriminator=PatchDiscriminator(torch.Generator().manual_seed(0)),
        )
        optimizer.bfloat16 = False  # faster, where the crops are as small as these
        optimizer.index = preset.pretraining
        left_out = torch.zeros(VIEWS, dtype=torch.bool)
        left_out[0::PARTS] = True
        optimizer.sampler.source_count.fill_(views.leave_out(left_out))
        for _ in range(6):
            optimizer.step()
        textures.append(optimizer.values.detach())
    assert torch.equal(*textures)
    assert not torch.equal(textures[0], spoiled(maps, 1.0))
