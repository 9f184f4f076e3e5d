"""What a check found: sentences, each with how bad it is and what it is about."""

from dataclasses import dataclass
from enum import IntEnum


class Level(IntEnum):
    """How bad it is; the largest one decides the exit code of the command."""

    NOTE = 0
    """Worth knowing."""
    WRONG = 1
    """A fit would begin and learn something wrong."""
    REFUSED = 2
    """A fit would refuse it."""


@dataclass(frozen=True)
class Finding:
    """One sentence."""

    level: Level
    about: str
    """One word: scene, units, camera, photograph, edges, lamp, exposure or surfaces."""
    sentence: str
    view: str = ""
    """The view that it is about, if it is one."""

    @property
    def text(self) -> str:
        """The sentence, with the view before it."""
        return f"view {self.view}: {self.sentence}" if self.view else self.sentence


class Findings(list[Finding]):
    """All of them, in the order in which they were found."""

    def add(self, level: Level, about: str, sentence: str, view: str = "") -> None:
        """Add one, unless it has been said."""
        finding = Finding(level, about, sentence, view)
        if finding not in self:
            self.append(finding)

    def of(self, level: Level) -> list[Finding]:
        """Those of a level."""
        return [finding for finding in self if finding.level == level]

    def bad(self, view: str) -> list[Finding]:
        """What is wrong with a view."""
        return [finding for finding in self if finding.view == view and finding.level > Level.NOTE]

    @property
    def worst(self) -> Level:
        """The largest level; NOTE where nothing is wrong."""
        return max((finding.level for finding in self), default=Level.NOTE)
