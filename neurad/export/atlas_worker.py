"""A program of its own that makes atlases: xatlas may crash on a broken mesh or never end, and then only this does.

Started by :mod:`neurad.export.atlas`, which gives it work line by line; imports nothing of neurad.
"""

import os
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
        self.source = ""
        self.charts: Arrays = ()
        """Vertices [v], triangles [f, 3] and the charts in scene units [v, 2]."""

    def make(self, source: str, density: float, target: str) -> str:
        """Write the atlas of the mesh in ``source`` (``vertices``, ``faces``) with so many texels per length to
        ``target``.

        Returns:
            'made', or why there is none.
        """
        atlas = xatlas.Atlas()
        again = source == self.source
        if again:
            vertex, faces, charts = self.charts
            atlas.add_uv_mesh(charts, faces)
        else:
            given = np.load(source)
            atlas.add_mesh(given["vertices"], given["faces"])
        options = xatlas.PackOptions()
        options.padding = PADDING
        options.bilinear = True
        options.texels_per_unit = density
        atlas.generate(xatlas.ChartOptions(), options)
        if atlas.atlas_count != 1:
            return f"{atlas.atlas_count} atlases"
        found, faces, uvs = atlas[0]
        vertex = vertex[found] if again else found
        size = np.array([atlas.width, atlas.height], np.int64)
        if not again:
            charts = np.ascontiguousarray(uvs * size / density, np.float32)
            self.source, self.charts = source, (vertex, faces, charts)
        np.savez(target, vertex=vertex, faces=faces, uvs=uvs, size=size)
        return "made"


def main() -> None:
    """For each line of input, a mesh, a density and a target, make an atlas, and answer with a line."""
    number, seconds = int(sys.argv[1]), float(sys.argv[2])
    if hasattr(os, "sched_setaffinity"):  # its threads spin while they wait: with one core to run on it starts none
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {cores[number % len(cores)]})
    maker = Maker()
    for line in sys.stdin:
        source, density, target = line.rstrip("\n").split("\t")
        if hasattr(signal, "setitimer"):  # ends the process, whatever it is in, once it has computed for so long
            signal.setitimer(signal.ITIMER_PROF, seconds)
        try:
            answer = maker.make(source, float(density), target)
        except Exception as error:  # a mesh that xatlas refuses
            answer = f"{type(error).__name__}: {error}"
        print(" ".join(answer.split()), flush=True)


if __name__ == "__main__":
    main()
