"""What reading pictures changed or guessed: counted over all files, said once."""

from pathlib import Path

from neurad.runtime.progress import say
from neurad.runtime.reading import shown

_waiting: dict[str, dict[str, int]] = {}
_said: set[tuple[str, str]] = set()


def note(kind: str, path: str | Path, pixels: int = 1) -> None:
    """Keep what happened to a picture until :func:`say_pictures`.

    Args:
        kind: what happened, the rest of a sentence that begins with the file's name and how many others; ``{}`` in it
            stands for how many pixels of all of them.
        path: of the file; another time it is not said again.
        pixels: of this file that are concerned.
    """
    if (kind, str(path)) not in _said:
        _said.add((kind, str(path)))
        _waiting.setdefault(kind, {})[str(path)] = pixels


def say_pictures() -> None:
    """Print what was kept, a line for each kind."""
    while _waiting:
        kind = next(iter(_waiting))
        files = _waiting.pop(kind)
        others = f" and {len(files) - 1} other{'s' if len(files) > 2 else ''}" if len(files) > 1 else ""
        say(f"{shown(Path(next(iter(files))).name)}{others}: {kind.format(sum(files.values()))}")
