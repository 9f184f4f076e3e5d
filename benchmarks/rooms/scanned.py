"""``python -m benchmarks.rooms.scanned SRC DST``: a room as somebody with a phone captures it.

All meshes are one, decimated and bent in waves, of one grey material, and nothing is said of lamps. Photographs are
JPEG files of unlike exposures, and training cameras are a little off; held-out views and true maps stay as they are.
"""

import argparse
import json
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
from neurad.core.records import View
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
    write_capture(capture, source, folder)


def write_capture(capture: Capture, source: Path, folder: Path) -> None:
    """Write the folder, with links to the true maps of its source."""
    images = folder / "images"
    images.mkdir(parents=True)
    scene = capture.written(images, capture.scene.train[0].camera.width)
    (mesh,) = scene.meshes
    write_ply(folder / "scan.ply", mesh)
    (folder / "scene.xml").write_text(SCENE.format(depth=scene.max_depth, rr=scene.rr_depth, lamps=""))
    white = float(np.quantile(np.concatenate([image.ravel() for image in capture.photographs]), 0.99))
    test = []
    for view in scene.test:
        path = images / f"{view.name}.exr"
        write_exr(path, read_view(view) * np.float32(WHITE / white))
        test.append(replace(view, image=str(path)))
    for kind in ("albedo", "roughness", "metallic"):
        if (source / kind).is_dir():
            (folder / kind).symlink_to((source / kind).resolve())
    for name, views in (("train", scene.train), ("test", test)):
        frames = [_frame(view, folder, source) for view in views]
        (folder / f"transforms_{name}.json").write_text(json.dumps({"frames": frames}, indent=1) + "\n")


def _frame(view: View, folder: Path, source: Path) -> dict[str, object]:
    """A view as camera files have it; true maps are those of held-out views."""
    camera = view.camera
    maps = {f"{kind}_path": str(Path(path).relative_to(source.resolve())) for kind, path in view.maps.items()}
    return {
        "file_path": str(Path(str(view.image)).relative_to(folder)), "w": camera.width, "h": camera.height,
        "camera_angle_x": camera.fov_x, "transform_matrix": np.asarray(camera.to_world, np.float64).tolist(), **maps,
    }  # fmt: skip


if __name__ == "__main__":
    main()
