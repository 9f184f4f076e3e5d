"""A scene folder of a few kilobytes, for tests that spoil one thing in it."""

import json
from pathlib import Path

import numpy as np

from datamodules.scene_data import SceneData
from datamodules.settings import DataSettings
from neurad.images.image_io import read_exr, to_srgb, write_exr

SIZE = 8

PLY = """ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
property float u
property float v
element face {faces}
property list uchar int vertex_indices
end_header
-1 0 1 0 0
1 0 1 1 0
1 0 -1 1 1
-1 0 -1 0 1
"""

XML = """<scene version="3.0.0">
  <default name="depth" value="6"/>
  <integrator type="path"><integer name="max_depth" value="$depth"/><integer name="rr_depth" value="4"/></integrator>
  <bsdf type="twosided" id="paint"><bsdf type="principled">
    <texture type="bitmap" name="base_color"><string name="filename" value="textures/paint.png"/></texture>
    <float name="roughness" value="0.4"/>
  </bsdf></bsdf>
  <shape type="ply" id="floor"><string name="filename" value="meshes/floor.ply"/><ref id="paint"/></shape>
  <shape type="rectangle" id="lamp">
    <transform name="to_world"><rotate x="1" angle="90"/><translate y="2"/></transform>
    <bsdf type="diffuse"><rgb name="reflectance" value="0.1, 0.2, 0.3"/></bsdf>
    <emitter type="area"><rgb name="radiance" value="1, 2, 3"/></emitter>
  </shape>
</scene>
"""

POSE = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 1.0], [0.0, 0.0, 1.0, 4.0], [0.0, 0.0, 0.0, 1.0]]


def write_scene(folder: Path, views: int = 3, channels: int = 3) -> Path:
    """Write a correct scene folder and return it; no ground-truth maps."""
    from PIL import Image

    rng = np.random.default_rng(1)
    for name in ("meshes", "textures", "images"):
        (folder / name).mkdir(parents=True)
    (folder / "scene.xml").write_text(XML)
    (folder / "meshes/floor.ply").write_text(PLY.format(faces=2) + "3 0 1 2\n3 0 2 3\n")
    Image.fromarray(rng.integers(0, 256, (4, 5, 3), dtype=np.uint8)).save(folder / "textures/paint.png")
    for part, count in (("train", views), ("test", 2)):
        frames = [{"file_path": f"images/{part}_{i}.exr", "transform_matrix": POSE} for i in range(count)]
        write_json(folder, part, {"camera_angle_x": 0.9, "w": SIZE, "h": SIZE, "frames": frames})
        for i in range(count):
            write_exr(folder / f"images/{part}_{i}.exr", rng.random((SIZE, SIZE, channels), np.float32))
    return folder


def ready(folder: Path, replace_every: int = SceneData.replace_every, **settings) -> SceneData:
    """The photographs of a scene folder, read for a fit."""
    data = SceneData(DataSettings(str(folder), **settings))
    data.replace_every = replace_every
    data.setup("fit")
    return data


def read_json(folder: Path, part: str) -> dict:
    return json.loads((folder / f"transforms_{part}.json").read_text())


def write_json(folder: Path, part: str, value: dict) -> None:
    (folder / f"transforms_{part}.json").write_text(json.dumps(value))


def as_png(folder: Path, gain: float = 1.0) -> Path:
    """Replace the photographs of a scene folder by sRGB pictures of 8 bits, ``gain`` times as bright."""
    from PIL import Image

    for part in ("train", "test"):
        described = read_json(folder, part)
        for frame in described["frames"]:
            path = folder / frame["file_path"]
            codes = (to_srgb(gain * read_exr(path)) * 255.0 + 0.5).astype(np.uint8)
            path.unlink()
            Image.fromarray(codes).save(path.with_suffix(".png"))
            frame["file_path"] = frame["file_path"].replace(".exr", ".png")
        write_json(folder, part, described)
    return folder
