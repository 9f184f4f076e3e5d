"""How far the work is: a phase on the terminal's line, stage after stage."""

from __future__ import annotations

from contextlib import ExitStack

from neurad.runtime.progress import Phase, phase


class StageProgress:
    """A phase for each stage; the next one ends it."""

    def __init__(self) -> None:
        self._stack = ExitStack()
        self._phase: Phase | None = None

    def stage(self, name: str, total: int) -> None:
        """A stage begins that has so many steps."""
        self.close()
        self._phase = self._stack.enter_context(phase(name, total))

    def step(self, count: int = 1) -> None:
        """Steps of the present stage are done."""
        if self._phase is not None:
            self._phase.step(count)

    def close(self) -> None:
        """The last stage is done."""
        self._stack.close()
        self._phase = None
