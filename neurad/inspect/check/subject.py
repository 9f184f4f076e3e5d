"""What is checked, in numbers: counts and bounds."""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import dataclass

from neurad.integrators.world import World
from neurad.scene.description import Scene
from neurad.scene.origin import place_text


@dataclass(frozen=True)
class Counts:
    """How large a scene is."""

    name: str
    triangles: int
    meshes: int
    materials: int
    lamps: int
    power: float
    """Power of all lamps, the mean of their channels, in units of radiance times area."""
    environment: str
    """What there is of one, in words."""
    train: int
    test: int
    sizes: str
    """Sizes of the photographs in pixels."""
    low: Sequence[float]
    high: Sequence[float]
    across: float
    """Diameter without stray triangles."""

    @classmethod
    def of(cls, scene: Scene, world: World, power: float) -> Counts:
        """Count."""
        sizes = sorted({(view.camera.width, view.camera.height) for view in (*scene.train, *scene.test)})
        said = ", ".join(f"{w} x {h}" for w, h in sizes[:4]) + (f" and {len(sizes) - 4} more" if len(sizes) > 4 else "")
        sky = scene.environment
        low, high = (scene.bounds + scene.origin).tolist()
        return cls(
            scene.name, len(world.geometry.faces), len(scene.meshes), len(scene.materials),
            sum(mesh.radiance is not None and bool(mesh.radiance.any()) for mesh in scene.meshes), power,
            "none" if sky is None else f"{sky.pixels.shape[1]} x {sky.pixels.shape[0]}, up to {sky.pixels.max():.3g}",
            len(scene.train), len(scene.test), said, low, high, 2.0 * world.geometry.scale,
        )  # fmt: skip

    def rows(self) -> list[list[str]]:
        """Label and value, HTML."""
        box = " to ".join(f"({place_text(corner)})" for corner in (self.low, self.high))
        pairs = [
            ("triangles, meshes, materials", f"{self.triangles}, {self.meshes}, {self.materials}"),
            ("bounds", f"{box}, {self.across:.4g} units across"),
            ("lamps", f"{self.lamps}, power {self.power:.4g} (radiance times area)" if self.lamps else "none"),
            ("environment", self.environment),
            ("views", f"{self.train} to learn from, {self.test} held out, of {self.sizes} pixels"),
        ]
        return [[html.escape(label), html.escape(value)] for label, value in pairs]

    def lines(self) -> list[str]:
        """The subject in lines for a terminal."""
        return [f"{html.unescape(label)}: {html.unescape(value)}" for label, value in self.rows()]
