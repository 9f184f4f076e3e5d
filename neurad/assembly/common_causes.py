"""What all photographs may have in common that is wrong, in words: said before any lamp is blamed for it."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from neurad.core.protocols import PhotoSource
from neurad.core.scene_records import Camera
from neurad.evidence.edge_fit import SharedTurn, edge_view, shared_turn
from neurad.evidence.photograph_pairs import LEAST_VIEWS, Develop, brightness_of, some_views
from neurad.evidence.shading import Transport, transport
from neurad.evidence.shared_errors import CHANCE, MATTERS, Estimate, SharedErrors, shared_errors
from neurad.integrators.world import World

OPEN = 0.01
"""Fraction of directions that leave the scene from which on a sky may be what was added."""
CURVES = 0.4, 2.6
"""Powers that response curves have, or what undoes them."""
LEAST_EDGES = 100
"""Places along edges below which a view says nothing of zoom and turn."""


def common_causes(
    world: World,
    cameras: Sequence[Camera],
    photographs: PhotoSource,
    seed: int,
    develop: Develop | None = None,
    views: Sequence[tuple[Tensor, Camera, Tensor]] | None = None,
    lit: bool = True,
    scale_known: bool = False,
    declared: World | None = None,
    power: float | None = None,
    offset: float | None = None,
) -> list[str]:
    """Look at photographs for what is wrong with all of them; a sentence each, none where nothing is.

    Args:
        world: of the scene, with its lights as they are known, of lamps as they are photographed.
        develop: corrects them by what a fit has recovered of how they were taken.
        views: ranks, cameras and directions to edges where they are known, see :func:`shared_turn`.
        lit: whether the lights are known well enough for brightness to be compared with light.
        scale_known: whether photographs show a lamp as bright as it is taken for; else light may be of another scale.
        declared: the same with lamps as the scene has them, where they are photographed differently.
        power: of a curve that explains that, or None.
        offset: what explains it if it is added to every photograph, or None.
    """
    if len(cameras) < LEAST_VIEWS or not photographs.has_photographs:
        return []
    if views is None:
        views = _edge_views(world, cameras, photographs, develop)
    moves = world.flash is not None  # no two views show a surface in the same light
    found = None if moves else shared_errors(world, cameras, photographs, develop)
    turn = shared_turn([view for view in views if len(view[2]) >= LEAST_EDGES])
    if turn and not (found and found.border):  # the edges of a border are like those of another field of view
        return [_of_turn(turn)]  # places that do not belong together say nothing else
    said = [] if found is None else _of_places(found)
    # Where something of that is found, brightness is not that of surfaces, and light is not compared with it.
    if lit and not moves and not said and (light := transport(world, cameras, photographs, seed, develop)):
        if declared and (power or offset) and (other := transport(declared, cameras, photographs, seed, develop)):
            said += _or_lamps(light, other, power, offset)
        said = said or _of_light(light, scale_known)
    return said


def _edge_views(
    world: World, cameras: Sequence[Camera], photographs: PhotoSource, develop: Develop | None
) -> list[tuple[Tensor, Camera, Tensor]]:
    found = []
    for index in some_views(len(cameras)):
        camera = cameras[index]
        pixel = torch.arange(camera.width * camera.height)
        color = brightness_of(photographs, develop, torch.full_like(pixel, index), pixel, None).nan_to_num(0.0)
        picture = color.view(camera.height, camera.width, 3).float().numpy()
        found.append(edge_view(world, camera, picture, index))
    return found


def _of_turn(turn: SharedTurn) -> str:
    if turn.kind == "zoom":
        how = "larger" if turn.amount > 1.0 else "smaller"
        return (
            f"all photographs show the edges of the geometry {100 * abs(turn.amount - 1):.0f} % {how} than the cameras "
            f"see them: the field of view (focal length) of the camera file is off by about {turn.amount:.2f}, or the "
            "photographs were cropped"
        )
    if turn.kind == "roll":
        how = f"rolled by about {abs(turn.amount):.1f} degrees {'clockwise' if turn.amount > 0 else 'counterclockwise'}"
    else:
        towards = {"right": ("right", "left"), "down": ("bottom", "top")}[turn.kind][turn.amount < 0]
        how = f"shifted by about {100 * abs(turn.amount):.1f} % of the width to the {towards}"
    return (
        f"all photographs are {how} against what the cameras see of the geometry: check the principal point, a crop, "
        "or the frame of the poses"
    )


def _of_places(found: SharedErrors) -> list[str]:
    said = []
    if found.border:
        sides = ", ".join(f"{side} {100 * part:.0f} %" for side, part in found.border.items())
        said.append(f"all photographs have a border ({sides} of the picture) that shows nothing of the scene: mask it")
    elif found.marked:
        said.append(
            f"all photographs have the same mark in {100 * found.marked:.1f} % of the picture, whatever lies behind: a "
            "watermark, dust or a part of the camera's mount; mask it"
        )
    if found.falloff.differs():
        falloff = found.falloff.value
        how, cause = ("darker", "vignetting") if falloff < 0 else ("brighter", "a correction of vignetting too many")
        said.append(
            f"all photographs are {100 * abs(1 - math.exp(falloff)):.0f} % {how} towards the corners than in the "
            f"middle, whatever they show: {cause}; correct it before"
        )
    if found.spread.differs():
        said.append(
            f"the photographs' exposures differ by {100 * found.spread.value:.0f} % (standard deviation) where they "
            "show the same surfaces: give them, or recover them with --data.exposure fit"
        )
    return said


def _of_light(light: Transport, scale_known: bool) -> list[str]:
    from scipy.optimize import minimize_scalar  # imported where it is needed: it loads slowly

    plain, coated = light.slope(), light.slope(coat=light.coat)
    if (plain.value - 1.0) * (coated.value - 1.0) <= 0.0:  # what coats do lies between
        return []
    slope, coat = min((plain, 0.0), (coated, light.coat), key=lambda one: abs(one[0].value - 1.0))
    if not slope.differs(1.0):
        return []
    flat, open_ = slope.value < 1.0, light.escaping >= OPEN
    lamps = [] if scale_known else ["lights of the scene that are too " + ("bright" if flat else "dim")]
    among = (CURVES[0], 1.0) if flat else (1.0, CURVES[1])
    power = minimize_scalar(
        lambda p: (light.slope(p, coat=coat).value - 1.0) ** 2, bounds=among, options={"xatol": 0.02}
    ).x
    curve = f"a response curve that was not taken back (gamma, about {power:.1f})"
    # What was added is no more than the darkest place shows: is that enough?
    less = light.slope(offset=light.floor, coat=coat)
    if flat and light.floor > MATTERS and (less.value > 1.0 or not less.differs(1.0)):
        causes = ["haze", "a black offset", *(["a sky that the scene does not have"] if open_ else []), *lamps]
        causes += [] if light.slope(power, coat=coat).differs(1.0) else [curve]
        return [
            f"no surface in any photograph is darker than {100 * light.floor:.0f} % of their mean, and dark places are "
            f"brighter than the scene's light makes them: {', '.join(causes[:-1])} or {causes[-1]}; these look alike"
        ]
    causes = [curve]
    causes += (["light that is missing in the scene, such as a sky"] if flat and open_ else []) + lamps
    return [
        f"along surfaces the photographs' brightness rises with the power {slope.value:.2f} of the light that arrives: "
        f"{' or '.join(causes)}{', which look alike here' if len(causes) > 1 else ''}"
    ]


def _or_lamps(shown: Transport, declared: Transport, power: float | None, offset: float | None) -> list[str]:
    """What explains lamps that are photographed too bright or too dark, and the light on surfaces, better than lamps of
    another radiance do, or as well: by the ratio of likelihoods (Wilks), where each makes brightness follow the light.

    Args:
        power: of the curve that makes photographs of the declared lamps what they are; None for no such curve.
        offset: what has to be added to the declared radiance for that; None for no such offset.
    """
    from scipy.special import chdtri  # imported where it is needed: it loads slowly

    said, decided, others = [], float(chdtri(1, CHANCE)), dict[str, Estimate]()
    of_lamps = shown.slope().off(1.0)
    if power and CURVES[0] < power < CURVES[1]:
        curve = f"a response curve that was not taken back (gamma, about {power:.2f})"
        others[curve] = declared.slope(power)
    share = (offset or np.inf) / declared.photographed.mean()
    if share < (1.0 + MATTERS) * declared.floor:
        others["haze or a black offset"] = declared.slope(offset=share)
    for what, slope in others.items():
        if (worse := slope.off(1.0) - of_lamps) < decided:
            how = "better than" if worse < -decided else "as well as"
            said.append(f"{what} explains all photographs {how} lamps of another radiance do")
    return said
