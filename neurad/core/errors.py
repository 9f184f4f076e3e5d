"""The one exception that a user's mistake raises."""

from collections.abc import Iterator
from contextlib import contextmanager

MAX_SAID = 40
"""Sentences of one message; the rest is counted."""


class InputError(Exception):
    """Input that neurad cannot use: one sentence that names the file or option and what is wrong with it.

    The command line prints the sentence and ends with exit code 2, without a traceback.
    """


class Refusals:
    """What stands in the way of reading a file whose parts do not depend on one another: all of it is said at once."""

    def __init__(self) -> None:
        self._said: dict[str, None] = {}

    @contextmanager
    def part(self) -> Iterator[None]:
        """Around the reading of a part: what it is refused for is kept until :meth:`end`."""
        try:
            yield
        except InputError as error:
            self._said[str(error)] = None

    def end(self) -> None:
        """End the reading.

        Raises:
            InputError: a part was refused; of several the message has a sentence each, those that are alike once.
        """
        said = [*self._said]
        if len(said) == 1:
            raise InputError(said[0])
        if said:
            listed = "; ".join(f"({i}) {sentence}" for i, sentence in enumerate(said[:MAX_SAID], 1))
            more = f"; and {len(said) - MAX_SAID} more" if len(said) > MAX_SAID else ""
            raise InputError(f"{len(said)} things stand in the way: {listed}{more}")
