"""A program of its own that makes atlases: xatlas may crash on a broken mesh or never end, and then only this does.

Started by :mod:`neurad.export.atlas`, which gives it work line by line; imports nothing of neurad.
"""

from __future__ import annotations

import os
import sys

import numpy as np
import xatlas

PADDING = 4
"""Texels between charts."""


def make(source: str, target: str) -> str:
    """Read ``vertices``, ``faces`` and the wanted texels per length from ``source``; write the atlas to ``target``.

    Returns:
        'made', or why there is none.
    """
    given = np.load(source)
    atlas = xatlas.Atlas()
    atlas.add_mesh(given["vertices"], given["faces"])
    options = xatlas.PackOptions()
    options.padding = PADDING
    options.bilinear = True
    options.texels_per_unit = float(given["density"])
    atlas.generate(xatlas.ChartOptions(), options)
    if atlas.atlas_count != 1:
        return f"{atlas.atlas_count} atlases"
    vertex, faces, uvs = atlas[0]
    size = np.array([atlas.width, atlas.height], np.int64)
    np.savez(target, vertex=vertex, faces=faces, uvs=uvs, size=size)
    return "made"


def main() -> None:
    """For each line of input with two paths make an atlas, and answer with a line."""
    if hasattr(os, "sched_setaffinity"):  # its threads spin while they wait: with one core to run on it starts none
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {cores[int(sys.argv[1]) % len(cores)]})
    for line in sys.stdin:
        source, target = line.rstrip("\n").split("\t")
        try:
            answer = make(source, target)
        except Exception as error:  # a mesh that xatlas refuses
            answer = f"{type(error).__name__}: {error}"
        print(" ".join(answer.split()), flush=True)


if __name__ == "__main__":
    main()
