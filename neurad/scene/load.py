"""The one door through which scenes come in."""

from __future__ import annotations

from neurad.core.errors import InputError
from neurad.scene.description import Scene


def load_scene(root: str | None, scene: str | None) -> Scene:
    """The scene of a folder or a built-in one, checked.

    Args:
        root: a scene folder (``--data.root``), or None.
        scene: name of a built-in scene (``--data.scene``), or None.

    Raises:
        InputError: not exactly one is given, the name is unknown, or the scene cannot be used.
    """
    if (root is None) == (scene is None):
        raise InputError("give exactly one of --data.root (a scene folder) and --data.scene (a built-in scene)")
    if root is not None:
        from neurad.scene.readers.nerf import read_folder

        return read_folder(root).check()
    from neurad.scene.builtin import build

    assert scene is not None
    return build(scene).check()
