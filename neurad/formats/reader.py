"""Readers of scene folders that are laid out in no way that neurad knows."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # settings name the class, and their help does without torch
    from neurad.core.records import Float64Array
    from neurad.formats.cameras.nerf import Split
    from neurad.scene.description import Scene


class Reader:
    """Reads what a subclass has a function for; the files that neurad knows tell the rest."""

    def surfaces(self, folder: Path, origin: Float64Array) -> Scene:
        """Meshes, materials and lights, without views.

        Args:
            folder: the scene folder.
            origin: what is subtracted from all coordinates [3], float64.
        """
        raise NotImplementedError

    def views(self, folder: Path, hold_out: int, pictures: bool) -> Split:
        """Training and held-out views.

        Args:
            folder: the scene folder.
            hold_out: every so many-th photograph is to be held out where nothing says which; 0 for none.
            pictures: whether photographs are wanted; otherwise none of them has to be there.
        """
        raise NotImplementedError

    def reads(self, what: str) -> bool:
        """Whether it has a function of its own for ``surfaces`` or ``views``."""
        return getattr(type(self), what) is not getattr(Reader, what)
