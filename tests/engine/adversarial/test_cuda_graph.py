"""Steps as a tape: what a CUDA graph does to a step, done to it on a CPU.

`Tape` writes down every operation of torch while the step runs once, and then carries out the operations by themselves:
no Python, the same tensors at the same addresses. Whatever a step asks the host for, a tape refuses as a capture would.
"""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import io
from collections.abc import Callable, Iterator
from typing import Any
from unittest import mock

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from advtex_engine.adversarial import cuda_graph as graphed
from advtex_engine.adversarial.cuda_graph import WARMUP, Stepper, capture_graph
from advtex_engine.adversarial.discriminator import PatchDiscriminator
from advtex_engine.adversarial.operations import plain_operations
from advtex_engine.adversarial.optimizer import AdversarialOptimizer
from advtex_engine.core.config import PRESETS, PRINTED, Preset
from advtex_engine.synthetic.planar import planar_views

REFUSED = {
    "aten::_local_scalar_dense",  # a number, or a bool, of Python's from a tensor
    "aten::lift_fresh",  # a tensor from numbers of Python's
    "aten::nonzero",
    "aten::masked_select",
    "aten::unique2",
    "aten::repeat_interleave",
    "aten::equal",
}
# Everything at once: pretraining, alignment, features, averaging, lambda and learning rates that fall.
PRESET = dataclasses.replace(
    PRESETS["standard"], pretraining=2, averaging=30, l1_decays=50, max_crop=(64, 64), perturbation=0.01
)
LAUNCH = 5
SMALL = dataclasses.replace(PRINTED, pretraining=4, averaging=20, max_crop=(32, 32))


class Tape(TorchDispatchMode):
    """Records while it is entered; `replay` does it all again."""

    def __init__(self) -> None:
        super().__init__()
        self.entries: list[tuple[Any, tuple[Any, ...], dict[str, Any], Any]] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        name = func.name().partition(".")[0]
        assert name not in REFUSED, f"{name} waits for the device"
        masks = [leaf for leaf in tree_leaves(args[1:]) if isinstance(leaf, torch.Tensor) and leaf.dtype == torch.bool]
        assert name not in ("aten::index", "aten::index_put_") or not masks, f"{name} by a mask waits for the device"
        result = func(*args, **kwargs)
        self.entries.append((func, args, kwargs, result))
        return result

    @torch.no_grad()
    def replay(self) -> None:
        for func, args, kwargs, recorded in self.entries:
            inputs = {leaf.untyped_storage().data_ptr() for leaf in tensors((args, kwargs))}
            for old, new in zip(tensors(recorded), tensors(func(*args, **kwargs)), strict=True):
                if old.untyped_storage().data_ptr() not in inputs:
                    old.copy_(new)


def tensors(tree: Any) -> list[torch.Tensor]:
    return [leaf for leaf in tree_leaves(tree) if isinstance(leaf, torch.Tensor)]


def tape_of(work: Callable[[], None], of: AdversarialOptimizer) -> Callable[[], None]:
    """As a capture does, this leaves the state as it was; a CPU carries `work` out while it is written down."""
    before, sums = copy.deepcopy(of.state_dict()), of._sums.clone()
    tape = Tape()
    with tape:
        work()
    of.load_state_dict(before)
    of._sums.copy_(sums)
    return tape.replay


def optimizer(preset: Preset = PRESET, steps: int = 100, *, branches: bool = False) -> AdversarialOptimizer:
    maps, pairs = planar_views(4, 96, 80, 1.2, torch.device("cpu"))
    start = torch.rand(maps.slots, 3, generator=torch.Generator().manual_seed(5))
    of = AdversarialOptimizer(
        maps,
        pairs,
        start,
        preset,
        kind="scene",
        steps=steps,
        generator=torch.Generator().manual_seed(0),
        discriminator=PatchDiscriminator(torch.Generator().manual_seed(0)),
        operations=plain_operations(),
    )
    of.branches = branches
    of.bfloat16 = False
    return of


def state(of: AdversarialOptimizer) -> list[torch.Tensor]:
    return [of.values.detach(), of.result, *(p.detach() for p in of.parameters), of.generator.get_state().float()]


def assert_same(a: AdversarialOptimizer, b: AdversarialOptimizer) -> None:
    assert a.index == b.index
    assert all(torch.equal(x, y) for x, y in zip(state(a), state(b), strict=True))


def test_a_step_asks_the_host_for_nothing_and_replays_as_itself() -> None:
    """Written down once in the pretraining, the tape goes on through its end, and through the fall of lambda."""
    plain, taped = optimizer(), optimizer()
    replay = tape_of(taped.device_step, taped)
    for _ in range(5):
        plain.step()
        replay()
        taped.count(1)
    assert_same(plain, taped)
    assert plain.drain_losses() == taped.drain_losses()


def test_the_paper_and_its_ablations_ask_the_host_for_nothing_either() -> None:
    for preset in (PRESETS["paper"], PRESETS["preview"], dataclasses.replace(PRESETS["paper"], condition=False)):
        of = optimizer(preset)
        tape_of(of.device_step, of)


def test_what_the_host_must_not_be_asked_is_refused() -> None:
    """The tape would notice: it refuses the step that branches, as it is taken on a CPU."""
    of = optimizer(dataclasses.replace(PRESET, pretraining=0), branches=True)
    with pytest.raises(AssertionError, match="waits for the device"):
        tape_of(of.device_step, of)


def stepper(of: AdversarialOptimizer) -> Stepper:
    return Stepper(of, lambda work, _: tape_of(work, of))


def take(by: Stepper, steps: int) -> list[int]:
    taken = list[int]()
    while sum(taken) < steps:
        taken.append(by.take(steps - sum(taken)))
    return taken


@pytest.fixture(autouse=True)
def short_launches(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(graphed, "STEPS_PER_LAUNCH", LAUNCH)


def test_launches_with_a_remainder_and_a_checkpoint_between_them_are_the_same_run() -> None:
    plain, launched, resumed = optimizer(SMALL), optimizer(SMALL), optimizer(SMALL)
    by = stepper(launched)
    assert take(by, 2 * LAUNCH) == [1] * WARMUP + [LAUNCH] + [1] * (LAUNCH - WARMUP)
    file = io.BytesIO()
    torch.save(launched.state_dict(), file)
    assert take(by, LAUNCH + 1) == [LAUNCH, 1]
    for _ in range(3 * LAUNCH + 1):
        plain.step()
    assert_same(plain, launched)
    # Into an optimizer that has captured already and gone on to somewhere else.
    other = stepper(resumed)
    take(other, LAUNCH + WARMUP)
    file.seek(0)
    resumed.load_state_dict(torch.load(file, weights_only=True))
    assert take(other, LAUNCH + 1) == [LAUNCH, 1]
    assert_same(plain, resumed)
    assert other.describe()["graph"]
    assert other.describe()["steps_per_launch"] == LAUNCH


def test_a_capture_that_fails_leaves_single_steps_and_the_reason() -> None:
    def failing(work: Callable[[], None], generator: torch.Generator) -> Callable[[], None]:
        raise RuntimeError("operation not permitted when stream is capturing")

    of = optimizer(SMALL)
    by = Stepper(of, failing)
    assert take(by, LAUNCH + WARMUP) == [1] * (LAUNCH + WARMUP)
    assert by.describe() == {
        "graph": False,
        "steps_per_launch": 1,
        "kernels": "torch",
        "precision": "fp32",
        "channels": 6,
        "reasons": {"graph": "the capture failed: operation not permitted when stream is capturing"},
    }


def test_a_capture_that_fails_gives_stream_and_generator_back(monkeypatch: pytest.MonkeyPatch) -> None:
    """torch ends the capture before it leaves the capture's stream, and does not leave it when the end raises."""
    current = ["main"]

    @contextlib.contextmanager
    def graph(*_: object, **__: object) -> Iterator[None]:
        current[0] = "capture"
        yield
        raise RuntimeError("the capture was invalidated")

    monkeypatch.setattr(torch.cuda, "CUDAGraph", mock.Mock())
    monkeypatch.setattr(torch.cuda, "graph", graph)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda _: current[0])
    monkeypatch.setattr(torch.cuda, "set_stream", lambda stream: current.__setitem__(0, stream))
    generator = mock.Mock()
    with pytest.raises(RuntimeError, match="invalidated"):
        capture_graph(lambda: None, generator)
    assert current == ["main"]
    generator.graphsafe_set_state.assert_called_once_with(generator.clone_state.return_value)


def test_a_cpu_takes_single_steps() -> None:
    by = Stepper(optimizer(SMALL))
    assert by.take(100) == 1
    assert by.describe()["reasons"]["graph"] == "the device is not an NVIDIA GPU"
