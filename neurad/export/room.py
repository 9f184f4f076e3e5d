"""What was recovered, as a scene whose every surface has a texture of its own: what all writers write."""

from dataclasses import dataclass

from neurad.export.bake import Baked
from neurad.export.charts import Chart
from neurad.formats.axes import Up
from neurad.scene.description import Scene


@dataclass(frozen=True)
class BakedRoom:
    """A baked scene."""

    scene: Scene
    """Mesh by mesh as the one that was fitted, triangles in the same order; one material a mesh, bitmaps float16."""
    names: list[str]
    """A name for each mesh that is unique and may be that of a file."""
    charts: list[Chart | None]
    """Where each mesh got its texture coordinates; None of meshes without textures."""
    baked: list[Baked | None]
    """Their textures."""
    seen: list[float]
    """Fraction of the camera rays of the training views that ended on each mesh."""
    up: Up
    hide_environment: bool
    """The photographs show no environment: they have an alpha channel."""

    @property
    def texels(self) -> int:
        """Number of texels of all textures."""
        return sum(chart.texels for chart in self.charts if chart is not None)
