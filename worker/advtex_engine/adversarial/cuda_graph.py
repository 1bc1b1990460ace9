"""Many steps per launch: a run of steps captured as one CUDA graph and replayed.

A step of 150 kernels costs the host a millisecond and an H200 a fraction of one. The first steps are taken one by one
on a side stream, as torch asks for before a capture (libraries set themselves up, no memory of theirs may come from the
graph's pool); they count like all others. Random numbers go on as they would without a graph: the generator is
registered with it. Where nothing can be captured, steps are taken one by one.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

import torch

from advtex_engine.adversarial.optimizer import AdversarialOptimizer

STEPS_PER_LAUNCH = 20
WARMUP = 3
AHEAD = 1  # launches that wait while one runs: the device is never idle, and a stop is noticed after two at most

GraphCapture = Callable[[Callable[[], None], torch.Generator], Callable[[], None]]
"""(work, generator) -> replay. `work` is called once, and nothing of it is carried out before the first replay."""


class Stepper:
    """Takes the steps of one optimizer, many at once where they can be captured.

    steps_per_launch: 1 where they cannot. reason: why not; None where they can, or where it has not been tried yet.
    Between launches the optimizer's state may be read, and changed in place.
    """

    def __init__(self, optimizer: AdversarialOptimizer, capture: GraphCapture | None = None) -> None:
        self.optimizer = optimizer
        on_gpu = optimizer.device.type == "cuda"
        self._capture = capture or (capture_graph if on_gpu else None)
        self.steps_per_launch = STEPS_PER_LAUNCH if self._capture else 1
        self.reason = None if self._capture else "the device is not an NVIDIA GPU"
        self._replay: Callable[[], None] | None = None
        self._warm = 0
        self._stream = torch.cuda.Stream(optimizer.device) if on_gpu else None  # type: ignore[no-untyped-call]
        self._ends: deque[torch.cuda.Event] = deque()

    def take(self, most: int) -> int:
        """Takes between 1 and `most` steps; returns how many."""
        assert most > 0
        if self._capture is None or most < self.steps_per_launch:
            self.optimizer.step()
            return 1
        if self._warm < WARMUP:
            self._warm += 1
            self._step_aside()
            return 1
        if self._replay is None and not self._captured(self._capture):
            return self.take(most)
        assert self._replay is not None
        self._replay()
        self.optimizer.count(self.steps_per_launch)
        self._hold_back()
        return self.steps_per_launch

    def describe(self) -> dict[str, Any]:
        """For the report: what was chosen, and why not the better."""
        optimizer = self.optimizer
        graph = self._replay is not None
        too_few = None if graph else "there were fewer steps than a launch takes"
        reasons = {"graph": self.reason or too_few, "kernels": optimizer.operations.reason}
        return {
            "graph": graph,
            "steps_per_launch": self.steps_per_launch if graph else 1,
            "kernels": optimizer.operations.name,
            "precision": "bf16" if optimizer.bfloat16 else "fp32",
            "channels": optimizer.form.channels,
            "reasons": {name: reason for name, reason in reasons.items() if reason},
        }

    def _captured(self, capture: GraphCapture) -> bool:
        try:
            self._replay = capture(self._launch, self.optimizer.generator)
        except RuntimeError as error:
            # Out of memory is one, too. Steps go on one by one; nothing of a failed capture was carried out.
            self._capture, self.steps_per_launch = None, 1
            self.reason = f"the capture failed: {error}"
            return False
        return True

    def _launch(self) -> None:
        for _ in range(self.steps_per_launch):
            self.optimizer.device_step()

    def _step_aside(self) -> None:
        if self._stream is None:
            self.optimizer.step()
            return
        current = torch.cuda.current_stream(self.optimizer.device)
        self._stream.wait_stream(current)
        with torch.cuda.stream(self._stream):
            self.optimizer.step()
        current.wait_stream(self._stream)

    def _hold_back(self) -> None:
        if self._stream is None:
            return
        end = torch.cuda.Event(blocking=True)  # type: ignore[no-untyped-call]  # no core is kept busy by the wait
        end.record(torch.cuda.current_stream(self.optimizer.device))
        self._ends.append(end)
        if len(self._ends) > AHEAD:
            self._ends.popleft().synchronize()


def capture_graph(work: Callable[[], None], generator: torch.Generator) -> Callable[[], None]:
    """Captures `work` on the generator's device; raises RuntimeError, with the generator as it was, if it cannot be."""
    before, stream = generator.clone_state(), torch.cuda.current_stream(generator.device)
    graph = torch.cuda.CUDAGraph()
    graph.register_generator_state(generator)
    try:
        # What other threads do (pictures are sent, a heartbeat) must not spoil the capture.
        with torch.cuda.graph(graph, capture_error_mode="thread_local"):
            work()
    except RuntimeError:
        # A capture that broke off leaves its stream the current one, and the generator's state marked as captured.
        torch.cuda.set_stream(stream)
        generator.graphsafe_set_state(before)
        raise
    return graph.replay
