"""What is under a pixel: material, how sure it is, and whose it is."""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch

from neurad.core.parameters import METALLIC, ROUGHNESS
from neurad.core.records import Float64Array, FloatArray, Rays
from neurad.inspect.maps import SeenMap
from neurad.runs.load import LoadedRun
from neurad.runtime.reading import listed
from neurad.scene.origin import place_text


@dataclass(frozen=True)
class Reading:
    """A surface point."""

    position: FloatArray
    """[3], relative to ``Scene.origin``."""
    place: Float64Array
    """The position in the coordinates of the scene's files [3]."""
    mesh: str
    values: dict[str, FloatArray]
    """Surface parameters [channels], by name."""
    stds: dict[str, FloatArray]
    """Their standard deviations, of those that have error bars."""
    photographs: tuple[str, ...]
    """Names of the training photographs that show it."""
    emits: bool
    """It is a lamp: its material is known."""
    digits: int
    """Digits after the point that positions are given with."""

    def lines(self) -> list[tuple[str, str]]:
        """Names and values for people."""
        values = {name: " ".join(f"{x:.3f}" for x in value) for name, value in self.values.items()}
        for name, std in ({} if self.emits else self.stds).items():
            values[name] += " ± " + " ".join(f"{x:.3f}" for x in std)
        if ROUGHNESS.name in values:
            values.setdefault(METALLIC.name, "0 (no surface here counts as a metal)")
        shown = "a guess, as none shows it" if not self.photographs and not self.emits else ""
        number = f"{len(self.photographs)}: " if self.photographs else ""
        return [*values.items(), ("photographs", shown or f"{number}{listed(self.photographs)}" or "none")]

    def written_place(self) -> list[float]:
        """The position in the coordinates of the scene's files, in as many digits as rays tell apart."""
        return [round(float(x), self.digits) for x in self.place]

    def place_lines(self) -> list[tuple[str, str]]:
        """What was clicked and where, for people."""
        known = " (known: a lamp)" if self.emits else ""
        return [("mesh", self.mesh + known), ("position", place_text(self.place, " "))]


def probe(run: LoadedRun, seen: SeenMap, origin: npt.ArrayLike, direction: npt.ArrayLike) -> Reading | None:
    """The first surface along a ray [3], whose direction may have any length; None where there is none."""
    d = np.asarray(direction, np.float64)
    ray = np.stack((np.asarray(origin, np.float64), d / np.linalg.norm(d))).astype(np.float32)
    o, d = torch.tensor(ray, device=run.device).unsqueeze(1)
    with torch.no_grad():
        si = run.world.intersect(Rays(o, d))
        if not bool(si.valid):
            return None
        views = seen.views(si)
    geometry = run.world.geometry
    prim = int(si.prim)
    return Reading(
        position=si.p[0].cpu().numpy(),
        place=si.p[0].double().cpu().numpy() + np.asarray(run.scene.origin),
        mesh=run.scene.meshes[int(geometry.mesh_index[prim])].name,
        values={name: run.map(name, si)[0] for name in run.maps},
        stds={name: run.map_std(name, si)[0] for name in run.uncertain},
        photographs=tuple(run.scene.train[index].name for index in views),
        emits=bool((geometry.emission[prim] > 0).any()),
        digits=max(0, 5 - math.floor(math.log10(max(geometry.scale, 1e-30)))),
    )
