"""The schedule's formulas, and the device's table of them."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from advtex_engine.adversarial.schedule import COLUMNS, Schedule
from advtex_engine.core.config import PRINTED, Preset

PRESET = dataclasses.replace(PRINTED, l1_decays=4, lr_end=0.1)


def schedule(steps: int, preset: Preset = PRESET) -> Schedule:
    return Schedule(preset, steps, torch.device("cpu"))


def test_lambda_falls_in_equal_periods_over_the_run() -> None:
    of = schedule(20)
    assert [of.l1_weight_at(index) for index in range(20)] == pytest.approx([10 * 0.8 ** (i // 5) for i in range(20)])


def test_the_learning_rates_fall_in_a_straight_line_after_the_pretraining() -> None:
    assert [schedule(20).lr_share_at(index) for index in (0, 10, 20)] == pytest.approx([1.0, 0.55, 0.1])
    late = schedule(20, dataclasses.replace(PRESET, pretraining=10))
    assert [late.lr_share_at(index) for index in (0, 10, 15)] == pytest.approx([1.0, 1.0, 0.55])
    assert [late.pretraining_at(index) for index in (0, 9, 10)] == [True, True, False]


def test_the_textures_rate_falls_by_a_power_of_lambdas_decay() -> None:
    of = schedule(20, dataclasses.replace(PRINTED, l1_decays=4, lr_texture=0.1, lr_follows=0.5))
    column = COLUMNS.index("lr_texture")
    rates = [of.row_at(index)[column] for index in (0, 4, 5, 10, 19)]
    assert rates == pytest.approx([0.1, 0.1, 0.1 * 0.8**0.5, 0.08, 0.1 * 0.8**1.5])
    assert {of.row_at(index)[COLUMNS.index("lr_discriminator")] for index in range(20)} == {PRINTED.lr_discriminator}


def test_the_average_takes_every_tenth_state_after_the_pretraining() -> None:
    of = schedule(60, dataclasses.replace(PRESET, pretraining=2, averaging=30))
    weights = {index: of.average_weight_at(index) for index in range(60) if of.average_weight_at(index)}
    assert weights == pytest.approx({2: 1.0, 12: 1 / 2, 22: 1 / 3, 32: 1 / 3, 42: 1 / 3, 52: 1 / 3})
    assert schedule(60).average_weight_at(10) == 0.0


def test_the_row_is_read_where_it_lies_and_follows_the_index() -> None:
    of = schedule(20, dataclasses.replace(PRESET, pretraining=3, averaging=30))
    names = [getattr(of, name) for name in COLUMNS]
    addresses = [tensor.data_ptr() for tensor in names]
    for index in (0, 1, 2, 3, 13, 14):
        of.index = index
        of.read()
        assert [float(tensor) for tensor in names] == pytest.approx(of.row_at(index))
    of.index = 7
    of.read()
    of.read()
    of.count(2)
    assert of.index == 9
    assert [float(tensor) for tensor in names] == pytest.approx(of.row_at(8))
    assert [tensor.data_ptr() for tensor in names] == addresses
