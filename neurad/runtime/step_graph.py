"""Work that is the same at every call, captured once as a CUDA graph and replayed: one launch in place of hundreds.

A graph holds what was done on the device while it was captured, at the same addresses, with the same numbers of the
host. So what changes between calls lies in tensors that are written in place, random numbers come from generators that
the graph knows, and a key names all else that the work depends on. Where there is no GPU the work is done at each call.
"""

from collections.abc import Callable, Hashable, Sequence
from typing import Any, Generic, TypeVar

import torch

from neurad.runtime.progress import say

T = TypeVar("T")

WARM_UP = 3
"""Calls before a capture: libraries and optimizers make their memory in them, and kernels are loaded."""
MAX_CAPTURES = 32
"""Captures after which the work is done at each call: each takes as long as some hundred replays."""


class StepGraph(Generic[T]):
    """Work without arguments and its graph.

    What cannot be captured, or gives other numbers when it is replayed, is done at each call from then on, and a line
    says so.

    Args:
        generators: of its random numbers. They are seeded before a call, not by the work.
        check: numbers of a result by which a replay is compared with the work itself, for work that may be repeated;
            None for work that changes what it reads.
        give_up: called when there will be no graph any more, before the work is done: a capture that failed may leave
            generators unusable, so the work needs new ones, seeded alike.
    """

    def __init__(
        self,
        device: torch.device,
        name: str,
        generators: Sequence[torch.Generator] = (),
        check: Callable[[T], torch.Tensor] | None = None,
        give_up: Callable[[], None] = lambda: None,
    ) -> None:
        self.device, self.name, self.generators, self.check, self.give_up = device, name, generators, check, give_up
        self.works = device.type == "cuda"
        """Whether graphs are captured."""
        self.captures = 0
        """Graphs so far."""
        self._key: Hashable = None
        self._calls = 0
        self._graph: Any = None
        self._stream: Any = None
        self._result: T | None = None

    def __call__(self, key: Hashable, work: Callable[[], T]) -> T:
        """The result of the work, whose tensors the next call overwrites.

        Args:
            key: all that the work depends on beside values of tensors.
            work: the same at every call with this key; it neither waits for the device nor reads from it.
        """
        if not self.works:
            return work()
        if key != self._key:
            self.forget()
            self._key = key
        if self._graph is None:
            self._calls += 1
            if self._calls <= WARM_UP:
                return self._beside(work)
            if not self._capture(work):
                return work()
        self._graph.replay()
        assert self._result is not None
        return self._result

    def forget(self) -> None:
        """Drop the graph; the next calls make another one."""
        self._graph, self._result, self._key, self._calls = None, None, None, 0

    def _beside(self, work: Callable[[], T]) -> T:
        """Do the work on a stream of its own: a capture allows no trace of it on the default one."""
        if self._stream is None:
            self._stream = torch.cuda.Stream(self.device)  # type: ignore[no-untyped-call]
        stream = self._stream
        stream.wait_stream(torch.cuda.current_stream(self.device))
        with torch.cuda.stream(stream):
            result = work()
        torch.cuda.current_stream(self.device).wait_stream(stream)
        return result

    def _capture(self, work: Callable[[], T]) -> bool:
        """Whether there is a graph now that does the same as the work."""
        seeds = [generator.initial_seed() for generator in self.generators]

        def again() -> None:
            for generator, seed in zip(self.generators, seeds, strict=True):
                generator.manual_seed(seed)

        try:
            if self.captures >= MAX_CAPTURES:
                raise RuntimeError(f"it changed {MAX_CAPTURES} times")
            expected = None if self.check is None else self.check(self._beside(work)).clone()
            again()
            graph = torch.cuda.CUDAGraph()
            for generator in self.generators:
                graph.register_generator_state(generator)
            with torch.cuda.graph(graph, capture_error_mode="thread_local"):
                result = work()
            again()
            if expected is not None and self.check is not None:
                graph.replay()
                found = self.check(result)
                if not torch.allclose(found, expected, rtol=1e-2, atol=1e-6, equal_nan=True):  # sums have no order
                    raise RuntimeError("a replay gives other numbers")
                again()
        except (RuntimeError, AttributeError) as error:
            self.works = False
            self.forget()
            reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
            self.give_up()
            say(f"{self.name} runs without a CUDA graph: {reason}")
            return False
        self._graph, self._result = graph, result
        self.captures += 1
        return True
