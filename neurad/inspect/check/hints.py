"""What would make a photograph fit that does not: a turn, a mirror image, other axes, or the pose of another view."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from neurad.core.scene_records import Camera
from neurad.evidence.edge_fit import EdgeFit, directions, edge_fit, mean_rank
from neurad.evidence.mesh_edges import mesh_edges, primary_grid
from neurad.inspect.check.look import Looked, page_width
from neurad.integrators.world import World

AXES = {
    "the frame is OpenCV's (x right, y down, looking along +z), where neurad takes NeRF's (y up, looking along -z)":
        (1.0, -1.0, -1.0),
    "the frame is Mitsuba's (x left, y up, looking along +z), where neurad takes NeRF's (x right, looking along -z)":
        (-1.0, 1.0, -1.0),
}  # fmt: skip
"""Signs of the camera's axes, by what they would mean."""
MIRRORS = {"the photograph is mirrored, left and right are exchanged": (1,), "the photograph is upside down": (0,),
           "the photograph is turned by half a turn": (0, 1)}  # fmt: skip
STEEP = 1.0
"""Standard deviations over turns by which a hint must fit better than what is turned from it."""
WORTH, NOTHING = 0.05, 0.6
"""Mean rank that it must gain, over that of the view or, where there is none, over this."""
FEWEST = 100
"""Places along edges below which a photograph is not judged."""


def explanation(world: World, one: Looked, others: Sequence[Looked]) -> str:
    """What other pose or mirroring would make it fit, or nothing. It needs no edges in sight of the camera."""
    assert one.ranks is not None
    assert one.camera is not None
    found: list[tuple[EdgeFit | None, str]] = []
    for words, dims in MIRRORS.items():
        found.append((edge_fit(one.ranks.flip(dims), one.camera, one.towards), words))
    for words, signs in AXES.items():
        pose = (one.view.camera.to_world @ np.diag([*signs, 1.0])).astype(one.view.camera.to_world.dtype)
        camera = replace(one.view.camera, to_world=pose)
        edges = mesh_edges(world, primary_grid(world, camera, page_width(camera.width)))
        found.append((edge_fit(one.ranks, one.camera, directions(edges, 0)), words))
    alike = [other for other in others if other is not one and _optics(other.view.camera) == _optics(one.view.camera)]
    if alike:  # the view, of those with the same camera, whose edges fit best
        means = [mean_rank(one.ranks, one.camera, other.towards) for other in alike]
        other = alike[int(np.argmax(means))]
        fit = edge_fit(one.ranks, one.camera, other.towards)
        found.append((fit, f"the photograph fits the pose of view {other.view.name}"))
    least = WORTH + (NOTHING if one.fit is None else one.fit.here)
    # A hint explains the photograph if it is a peak of its own, of enough edges, and a better one.
    clear = [(f, words) for f, words in found if f is not None and f.fits and f.places >= FEWEST and f.margin > STEEP]
    good = [(fit.here, words) for fit, words in clear if fit.here > least]
    return max(good)[1] if good else ""


def _optics(camera: Camera) -> tuple[Any, ...]:
    """What a camera is wherever it stands."""
    return camera.fov_x, camera.width, camera.height, camera.lens


def turned(fit: EdgeFit) -> str:
    """By how much the camera would have to be turned, where that fits clearly."""
    if -fit.margin < STEEP:
        return ""
    left, up, roll = fit.turn
    parts = [f"{abs(left):.1f} degrees to the {'left' if left > 0 else 'right'}"] if abs(left) > 0.05 else []
    parts += [f"{abs(up):.1f} degrees {'up' if up > 0 else 'down'}"] if abs(up) > 0.05 else []
    parts += [f"{abs(roll):.0f} degrees {'counterclockwise' if roll > 0 else 'clockwise'}"] if roll else []
    return f"it fits better with the camera turned by about {' and '.join(parts)}"
