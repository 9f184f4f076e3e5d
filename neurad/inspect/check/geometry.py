"""What a check says of triangles and cameras: units, cameras in walls or outside, surfaces that nobody shows."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from neurad.core.records import IntArray
from neurad.core.rng import Stream
from neurad.inspect.check.findings import Findings, Level
from neurad.inspect.check.look import Looked
from neurad.inspect.check.surroundings import Surroundings, surroundings
from neurad.integrators.world import World
from neurad.metrics.seen import SeenBy
from neurad.metrics.unseen import Unseen
from neurad.runtime.reading import listed
from neurad.scene.description import Scene
from neurad.scene.geometry import Geometry

LARGE, SMALL = 100.0, 0.1
"""Units across beyond which a room is not likely to be in metres."""
FAR_OUT, CLOSED = 0.9, 0.1
"""A camera is outside if nothing lies in this fraction of some half space, which is less before an open window, and in
less than the second of all directions around others."""
NARROW, TIGHT = 0.1, 1.0
"""Free width around a camera over that around others: inside a wall in any case, and if it sees backs of surfaces."""
BACKS, FRONTS = 0.8, 0.3
"""Fraction of the surfaces around it that a camera inside of a solid sees from behind, and a camera outside at most."""
NEARBY = 0.005
"""Median distance of what cameras see, over the size of the scene, below which both have different units."""
TOGETHER = 0.02
"""Size of the box of all cameras over that of a scene of no room's size, below which meshes alone have another unit."""

HOLE = 1e-3
"""Fraction of a photograph beyond which surfaces are missing there: fewer pixels are between triangles."""
POINTS = 1 << 14
"""Random points on all surfaces together, evenly by area, for how much of each is seen."""


@dataclass(frozen=True)
class Places:
    """Cameras in the geometry, and what they do not show."""

    around: list[Surroundings]
    """Surroundings of the training views, then of the held-out ones."""
    unseen_meshes: list[tuple[str, float, float]]
    """Name, fraction of all surface, and fraction of it that no training photograph shows; the largest first."""
    unseen: float
    """Fraction of all surface that no training photograph shows."""
    held_out: Unseen
    """What held-out views show and no training photograph does."""


def check_units(scene: Scene, world: World, looked: Sequence[Looked], findings: Findings) -> None:
    """Say whether lengths look like those of a room in metres, and cameras and meshes have the same ones."""
    across = 2.0 * world.geometry.scale
    if not SMALL <= across <= LARGE:
        factor = 10.0 ** -round(np.log10(across / 6.0))
        apart = float(np.ptp([one.view.camera.to_world[:3, 3] for one in looked], axis=0).max())
        advice = (
            "lengths of light transport need no unit, but exports and viewers take metres: scale meshes and cameras "
            f"by {factor:g}"
        )
        if len(looked) > 2 and apart < TOGETHER * across:
            within = f"all cameras lie within {apart:.3g} units"
            advice = f"and {within}: scale the meshes alone by {factor:g} (neurad data --scale)"
        findings.add(
            Level.WRONG, "units", f"the scene is {across:.4g} units across, which is no room in metres; {advice}"
        )
    distances = [one.distance for one in looked if np.isfinite(one.distance)]
    if distances and np.median(distances) < NEARBY * across:
        findings.add(
            Level.WRONG, "units",
            f"cameras see surfaces {np.median(distances):.3g} units away in a scene that is {across:.4g} units across: "
            "cameras and meshes have different units",
        )  # fmt: skip
    blind = [one.view.name for one in looked if one.surface == 0.0]
    if blind and len(blind) < len(looked):
        findings.add(Level.WRONG, "camera", f"no surface is in sight of {listed(blind, 6)}; check their poses")


def check_holes(scene: Scene, looked: Sequence[Looked], findings: Findings) -> None:
    """Say where photographs show something and there is no surface, nor an environment that could be seen there."""
    open_ = [one for one in looked if one.holes > HOLE]
    if scene.environment is None and open_:
        worst = max(open_, key=lambda one: one.holes)
        findings.add(
            Level.WRONG, "holes",
            f"in {len(open_)} of {len(looked)} views photographs show something where there is no surface (up to "
            f"{100 * worst.holes:.1f} % of the pixels, in {worst.view.name}): the mesh has holes, through which "
            "light is lost; close them (neurad data --close-holes), or give the environment that is seen there",
        )  # fmt: skip


def check_places(scene: Scene, world: World, looked: Sequence[Looked], seen_by: SeenBy, findings: Findings) -> Places:
    """Say which cameras are inside walls or outside of the room, and what no training photograph shows."""
    around = surroundings(world, [one.view.camera for one in looked])
    free, open_half, width, backs = (
        np.array([getattr(one, name) for one in around]) for name in ("free", "open_half", "width", "backs")
    )
    for index, one in enumerate(looked):
        others = np.arange(len(around)) != index
        if len(around) < 4:
            break
        usual = float(np.median(width[others]))
        if open_half[index] > FAR_OUT and np.median(free[others]) < CLOSED:
            findings.add(
                Level.WRONG, "camera",
                f"its camera is outside of the room: in {100 * free[index]:.0f} % of all directions there is nothing "
                f"(around other cameras in {100 * np.median(free[others]):.0f} %)", one.view.name,
            )  # fmt: skip
        elif np.isfinite(usual) and width[index] < usual * (
            TIGHT if backs[index] > BACKS and np.median(backs[others]) < FRONTS else NARROW
        ):
            findings.add(
                Level.WRONG, "camera",
                f"its camera is inside of a wall or a thing: free space around it is {width[index]:.3g} units wide "
                f"(around other cameras {usual:.3g}), {100 * backs[index]:.0f} % of it shows backs of surfaces",
                one.view.name,
            )  # fmt: skip
    points, seen = seen_points(world.geometry, seen_by, 1)
    lit = np.array([mesh.radiance is not None and bool(mesh.radiance.any()) for mesh in scene.meshes])
    total = max(int(points[~lit].sum()), 1)
    rows = [
        (mesh.name, float(points[i]) / total, 1.0 - float(seen[i]) / points[i])
        for i, mesh in enumerate(scene.meshes)
        if points[i] > 0 and not lit[i]
    ]
    rows.sort(key=lambda row: -row[1] * row[2])
    held_out = Unseen.of([{"seen": one.seen} for one in looked if one.seen is not None])
    places = Places(around, rows, 1.0 - float(seen[~lit].sum()) / total, held_out)
    findings.add(
        Level.NOTE, "surfaces",
        f"{100 * places.unseen:.0f} % of all surface, undersides and insides of things included, is in no training "
        f"photograph. {held_out.sentence()}".strip(),
    )  # fmt: skip
    return places


@torch.no_grad()
def seen_points(geometry: Geometry, seen_by: SeenBy, seed: int) -> tuple[IntArray, IntArray]:
    """For each mesh, how many random points lie on it, and how many of these a camera sees [meshes]."""
    device = geometry.vertices.device
    u = Stream(seed, 35, device=device).uniform(POINTS, 3)
    total = geometry.face_area.double().cumsum(0)
    prim = torch.searchsorted(total, u[:, 0].double() * total[-1]).clamp_max(len(total) - 1)
    root = u[:, 1].sqrt()
    ones = torch.ones(POINTS, dtype=torch.bool, device=device)
    si = geometry.interact_at(prim, root * (1.0 - u[:, 2]), root * u[:, 2], geometry.face_normal[prim], ones)
    seen = seen_by.any(si).cpu().numpy()
    mesh = geometry.mesh_index[prim].cpu().numpy()
    count = int(geometry.mesh_index.max()) + 1
    return np.bincount(mesh, minlength=count), np.bincount(mesh[seen], minlength=count)
