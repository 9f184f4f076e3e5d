"""Texture coordinates by xatlas, one mesh at a time in a process of its own that has a time limit."""

import math
import os
import pickle
import subprocess
import sys
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from neurad.core.scene_records import Mesh
from neurad.export.charts import MARGIN, Chart, find_charts, is_unique, triangle_areas
from neurad.export.texels import FILLED, LARGEST, SMALLEST

WORKER = Path(__file__).with_name("atlas_worker.py")
PADDING = 4
"""Texels between charts that are asked for."""
MIN_PADDING = 2.2
"""Texels that have to be left between them: each side of a lookup needs one."""
SECONDS = 60.0
"""Longest time for one mesh, on one core."""
SHARED = 10.0
"""Times that it may take so long on a machine that others use, too."""
COARSEST = 0.4
"""Fraction of the wanted texels a length at which the texture is doubled rather than the charts made smaller, as long
as texels are spare."""
LAST = 0.05
"""Fraction of the wanted texels a length at which the texture is doubled where no texels are spare."""
NEAR_ENOUGH = 0.8
"""Fraction of the texels a length that a mesh needs with which it is left alone."""
FOLDED = 1e-4
"""Fraction of the texels in which a chart may lie over itself: slivers along its edges fold over."""
TRIES = 12


class AtlasMaker:
    """A child process that makes atlases, started again after a mesh that it crashed on or did not end with. By their
    numbers, children stay on cores of their own.
    """

    def __init__(self, number: int) -> None:
        self.number = number
        self._process: subprocess.Popen[bytes] | None = None
        self._mesh: Mesh | None = None  # of which the child has the charts
        self._scale = 1.0

    def make(self, mesh: Mesh, density: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None:
        """Vertices [v], triangles [f, 3], coordinates in [0, 1] [v, 2] and size in texels [2]; None if there is none.

        Args:
            mesh: its positions and triangles; the same one again is only packed again. It is enlarged so that the mean
                triangle has area 1, since xatlas takes areas below 1e-7 for none.
            density: texels per unit of length.
        """
        given = None
        if mesh is not self._mesh:
            self._scale = 1.0 / (math.sqrt(float(triangle_areas(mesh.vertices[mesh.faces]).mean())) or 1.0)
            given = (mesh.vertices * np.float64(self._scale)).astype(np.float32), mesh.faces.astype(np.uint32)
        made = self._ask(given, density / self._scale)
        self._mesh = None if made is None else mesh
        if made is None:
            return None
        vertex, faces, uvs, size = made
        if not np.array_equal(vertex[faces], mesh.faces) or not np.isfinite(uvs).all() or size.min() < 1:
            return None
        return vertex, faces, uvs, size

    def _ask(self, mesh: tuple[np.ndarray, ...] | None, density: float) -> tuple[np.ndarray, ...] | None:
        """What the child makes of a mesh, or of its last one; None if that is nothing. If it crashes or takes too long,
        it is gone then.
        """
        if self._process is None:
            command = [sys.executable, "-P", str(WORKER), str(self.number), str(SECONDS)]
            environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
            self._process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=environment
            )
        process = self._process
        assert process.stdin is not None
        assert process.stdout is not None
        late = threading.Timer(SHARED * SECONDS, process.kill)
        late.start()
        try:
            pickle.dump((mesh, density), process.stdin)
            process.stdin.flush()
            made: tuple[np.ndarray, ...] | None = pickle.load(process.stdout)
        except (EOFError, OSError, pickle.UnpicklingError):
            self.close()
            return None
        finally:
            late.cancel()
        return made

    def close(self) -> None:
        """End the child."""
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None


class Spare:
    """Texels that nobody has asked for yet. Meshes take from them in this order, each when all before it are done, so
    that each gets the same in every export.
    """

    def __init__(self, texels: int, order: list[int]) -> None:
        self.texels = texels
        self._turn = {mesh: turn for turn, mesh in enumerate(order)}
        self._waiting = set(range(len(order)))
        self._changed = threading.Condition()

    def take(self, mesh: int, texels: int) -> bool:
        """Take so many for this mesh, if there are so many left."""
        with self._changed:
            self._changed.wait_for(lambda: min(self._waiting) >= self._turn[mesh])
            if texels > self.texels:
                return False
            self.texels -= texels
            return True

    def done(self, mesh: int) -> None:
        """This mesh takes no more."""
        with self._changed:
            self._waiting.remove(self._turn[mesh])
            self._changed.notify_all()


def atlas_chart(
    mesh: Mesh, width: int, height: int, area: float, needed: float, maker: AtlasMaker, take: Callable[[int], bool]
) -> Chart | None:
    """The mesh with an atlas in a texture of about this size; None where xatlas fails, takes too long, or the mesh
    falls into so many charts that they need more than the largest texture.

    Args:
        mesh: what it has of texture coordinates is dropped.
        width: of the texture; doubled together with the height until the charts fit with room between them.
        area: of the mesh, in scene units.
        needed: texels per unit of length; while the charts have much less, the texture is doubled from what is spare.
        take: takes so many texels of those that are spare, and tells whether there were enough.
    """
    wanted = 0.9 * math.sqrt(FILLED * width * height / area) if area > 0 else 1.0
    density, found = wanted, None
    for _ in range(TRIES):
        made = maker.make(mesh, density)
        if made is None:
            return None
        vertex, faces, uvs, packed = made
        short = max(height // 2, SMALLEST) if packed[1] * 2 <= packed[0] else height
        scale = float(((np.array([width, short]) - 2.0 * MARGIN) / packed).min())
        if PADDING * scale >= MIN_PADDING:
            placed = (MARGIN + uvs * packed * scale) / np.array([width, short])
            unwrapped = replace(mesh.of_vertices(vertex, faces.astype(np.int64)), uvs=placed.astype(np.float32))
            found = Chart(unwrapped, find_charts(unwrapped), width, short, "atlas")
            enough = density * scale >= NEAR_ENOUGH * needed or 2 * max(width, height) > LARGEST
            if enough or not take(3 * width * short):
                break
            width, height, wanted = 2 * width, 2 * short, 2.0 * density * scale
            density = wanted
            continue
        density *= 0.8 * scale
        # What lies between the charts does not shrink with them.
        if density < COARSEST * wanted and (take(3 * width * height) or density < LAST * wanted):
            width, height = 2 * width, 2 * height
            if max(width, height) > LARGEST:
                break
            density = wanted
    return found if found is not None and is_unique(found, FOLDED) else None
