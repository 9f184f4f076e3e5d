"""A program of its own that makes atlases: xatlas may crash on a broken mesh or never end, and then only this does.

Started by :mod:`neurad.export.atlas`, which gives it work by pickles; imports nothing of neurad.
"""

import os
import pickle
import signal
import sys

import numpy as np
import xatlas

PADDING = 4
"""Texels between charts."""
Arrays = tuple[np.ndarray, ...]


class Maker:
    """Atlases of one mesh after the other. The charts of the last mesh are kept: to pack them again for another texture
    takes a thirtieth of the time that it takes to find them.
    """

    def __init__(self) -> None:
        self.charts: Arrays = ()
        """Vertices [v], triangles [f, 3] and the charts in scene units [v, 2]."""

    def make(self, mesh: Arrays | None, density: float) -> Arrays | None:
        """The atlas of a mesh (vertices [v, 3] and triangles [f, 3]) or of the last one, with so many texels a length.

        Returns:
            The mesh's own number of each vertex [v], triangles [f, 3], coordinates [v, 2] and size in texels [2]; None
            if there is none.
        """
        atlas = xatlas.Atlas()
        if mesh is None:
            vertex, faces, charts = self.charts
            atlas.add_uv_mesh(charts, faces)
        else:
            atlas.add_mesh(*mesh)
        options = xatlas.PackOptions()
        options.padding = PADDING
        options.bilinear = True
        options.texels_per_unit = density
        atlas.generate(xatlas.ChartOptions(), options)
        if atlas.atlas_count != 1:
            return None
        found, faces, uvs = atlas[0]
        size = np.array([atlas.width, atlas.height], np.int64)
        if mesh is None:
            return vertex[found], faces, uvs, size
        self.charts = found, faces, np.ascontiguousarray(uvs * size / density, np.float32)
        return found, faces, uvs, size


def main() -> None:
    """Answer each mesh and density with an atlas, until there are no more."""
    number, seconds = int(sys.argv[1]), float(sys.argv[2])
    if hasattr(os, "sched_setaffinity"):  # its threads spin while they wait: with one core to run on it starts none
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {cores[number % len(cores)]})
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # what a library prints is no answer
    maker = Maker()
    while True:
        try:
            mesh, density = pickle.load(sys.stdin.buffer)
        except EOFError:
            return
        if hasattr(signal, "setitimer"):  # ends the process, whatever it is in, once it has computed for so long
            signal.setitimer(signal.ITIMER_PROF, seconds)
        try:
            made = maker.make(mesh, density)
        except Exception:  # a mesh that xatlas refuses
            made = None
        pickle.dump(made, answers)
        answers.flush()


if __name__ == "__main__":
    main()
