"""Scenes that need no file of the user's: small procedural ones, and two kitchens that ship."""

from collections.abc import Callable
from functools import partial

from neurad.core.errors import InputError
from neurad.core.suggest import did_you_mean
from neurad.scene.builtin.shipped import read_room
from neurad.scene.builtin.small import build_cornell, build_cube, build_furnace, build_sphere
from neurad.scene.description import Scene

__all__ = [
    "NAMES", "build", "build_cornell", "build_cube", "build_furnace", "build_sphere",
]  # fmt: skip

_BUILDERS: dict[str, Callable[[], Scene]] = {
    "kitchen": partial(read_room, "kitchen"),
    "patterns": partial(read_room, "patterns"),
    "cornell": build_cornell,
    "cube": build_cube,
    "furnace": build_furnace,
    "sphere": build_sphere,
}
NAMES: tuple[str, ...] = tuple(_BUILDERS)
"""Names of the built-in scenes."""


def build(name: str) -> Scene:
    """The built-in scene ``name``, one of :data:`NAMES`, with its standard settings.

    Raises:
        InputError: there is no scene of this name.
    """
    if name not in _BUILDERS:
        near = did_you_mean(name, NAMES)
        raise InputError(f"data.scene: there is no built-in scene {name!r}, choose one of {', '.join(NAMES)}{near}")
    return _BUILDERS[name]()
