"""What a person says of places in a room: that something shines there, is one material, or is to be left out."""

from dataclasses import dataclass

import numpy as np

from neurad.core.errors import InputError
from neurad.core.records import BoolArray, FloatArray, IntArray

REACH = 0.01
"""Times the size of the room that a point may lie beside the surface that it is on."""


@dataclass(frozen=True)
class PlaceHint:
    """A point on a surface, or a box around some, in the coordinates of the scene's files."""

    source: str
    """Who says so: begins the sentences about it."""
    place: tuple[float, ...]
    """Three numbers, or six of two corners."""

    @property
    def is_box(self) -> bool:
        """Whether it is a box."""
        return len(self.place) == 6

    def triangles(self, vertices: FloatArray, faces: IntArray, origin: tuple[float, float, float]) -> BoolArray:
        """The triangles ``faces`` [f, 3] within the box [f], or the one that lies nearest to the point; ``origin`` was
        subtracted from the coordinates of ``vertices`` [v, 3].

        Raises:
            InputError: nothing is there.
        """
        corners = vertices.astype(np.float64)[faces]  # [f, 3, 3]
        at = np.reshape(self.place, (-1, 3)) - np.array(origin)
        where = f"{self.source}: {', '.join(f'{x:g}' for x in self.place)}"
        if self.is_box:
            inside: BoolArray = ((corners >= at.min(0)) & (corners <= at.max(0))).all((1, 2))
            if not inside.any():
                raise InputError(f"{where}: no triangle lies within this box; make it larger")
            return inside
        from trimesh.triangles import closest_point  # imported where it is needed: it loads slowly

        on = closest_point(corners, np.broadcast_to(at[0], (len(corners), 3)))  # type: ignore[no-untyped-call]
        away = np.linalg.norm(on - at[0], axis=1)
        nearest = int(away.argmin())
        if not away[nearest] <= REACH * float(np.linalg.norm(np.ptp(corners.reshape(-1, 3), axis=0))):
            raise InputError(f"{where}: no surface is there; the nearest is {away[nearest]:.3g} away")
        return np.asarray(np.arange(len(corners)) == nearest)


@dataclass(frozen=True)
class Rectangle:
    """Pixels of a view, from the first column and row to those before the last."""

    source: str
    view: str
    """Its name."""
    corners: tuple[int, int, int, int]
    """Left, upper, right, lower: the right column and the lower row are outside."""


@dataclass(frozen=True)
class Hints:
    """All that is said of a room."""

    shines: tuple[PlaceHint, ...] = ()
    """Lamps of unknown radiance."""
    one_material: tuple[tuple[PlaceHint, ...], ...] = ()
    """Places whose connected surfaces are one material, in each entry."""
    leave_out: tuple[PlaceHint | Rectangle, ...] = ()
    """Connected surfaces, or what lies within a box, and parts of photographs that neither train nor score."""


NO_HINTS = Hints()
