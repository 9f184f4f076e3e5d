"""``python -m benchmarks.rooms.scanned SRC DST``: a room as somebody with a phone captures it.

All meshes are one, decimated and bent in waves, of one grey material, and nothing is said of lamps. Photographs are
JPEG files of unlike exposures, and training cameras are a little off; held-out views and true maps stay as they are.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.bench.damage import (
    WHITE,
    Capture,
    captured,
    change_exposures,
    compress,
    decimate_mesh,
    turn_cameras,
    wave_mesh,
)
from benchmarks.rooms.joined import SCENE, joined
from neurad.core.scene_records import Development
from neurad.formats.cameras.write import write_views
from neurad.formats.load import load_scene
from neurad.formats.meshes.ply import write_ply
from neurad.images.image_io import write_exr
from neurad.images.photographs import read_view

LEFT, WAVES = 0.2, 5.0
"""Fraction of the triangles that decimation leaves, and amplitude of the waves in millimetres."""
TURN, MOVE = 0.3, 5.0
"""By how many degrees and millimetres cameras are off."""


def main() -> None:
    """Write DST."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("source", type=Path, metavar="SRC", help="room folder, in metres")
    parser.add_argument("folder", type=Path, metavar="DST", help="room folder to write")
    parser.add_argument("--seed", type=int, default=0, help="of waves, exposures and cameras")
    asked = parser.parse_args()
    scan_room(asked.source, asked.folder, asked.seed)


def scan_room(source: Path, folder: Path, seed: int) -> None:
    """Write the captured room."""
    capture = captured(load_scene(str(source), None), seed)
    capture.scene = replace(capture.scene, meshes=[joined(capture.scene.meshes)])
    decimate_mesh(capture, LEFT)
    wave_mesh(capture, WAVES)
    turn_cameras(capture, TURN, MOVE)
    change_exposures(capture)
    compress(capture)
    write_capture(capture, folder)


def write_capture(capture: Capture, folder: Path) -> None:
    """Write the folder, with links to the true maps of held-out views."""
    images = folder / "images"
    images.mkdir(parents=True)
    scene = capture.written(images, capture.scene.train[0].camera.width)
    (mesh,) = scene.meshes
    write_ply(folder / "scan.ply", mesh)
    (folder / "scene.xml").write_text(SCENE.format(depth=scene.max_depth, rr=scene.rr_depth, lamps=""))
    train = [replace(view, name=Path(str(view.image)).stem, development=Development()) for view in scene.train]
    test = []
    for view in scene.test:
        path = images / f"{view.name}.exr"
        write_exr(path, read_view(view) * np.float32(WHITE / capture.white))
        test.append(replace(view, image=str(path)))
    write_views(replace(scene, train=train, test=test), folder, copy=False)


if __name__ == "__main__":
    main()
