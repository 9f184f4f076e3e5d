"""How far the work is: a bar on the terminal, stage after stage."""

from __future__ import annotations

import sys
from typing import Any, Protocol

from tqdm import tqdm


class Progress(Protocol):
    """What is told of the work."""

    def stage(self, name: str, total: int) -> None:
        """A stage begins that has so many steps."""

    def step(self, count: int = 1) -> None:
        """Steps of the present stage are done."""


class Bar:
    """A progress bar on stderr; none where stderr is no terminal."""

    def __init__(self) -> None:
        self._bar: Any = None

    def stage(self, name: str, total: int) -> None:
        """A stage begins that has so many steps."""
        self.close()
        self._bar = tqdm(total=total, desc=name, unit_scale=True, file=sys.stderr, disable=None, leave=False)

    def step(self, count: int = 1) -> None:
        """Steps of the present stage are done."""
        if self._bar is not None:
            self._bar.update(count)

    def close(self) -> None:
        """The last stage is done."""
        if self._bar is not None:
            self._bar.close()
            self._bar = None
