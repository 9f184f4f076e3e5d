"""``python -m benchmarks.rooms.daylight SRC DST``: a room folder whose lamps are out and whose windows let in the day.

Every shape of SRC's scene.xml with an area emitter is left out; those that stood in for windows leave a hole. Outside
is Mitsuba's ``sunsky`` above a ground of one reflectance. Mitsuba photographs the room again by the cameras of SRC, so
that the photographs' mean radiance is :data:`MEAN`. Views that are there already are kept.
"""

from __future__ import annotations

import argparse
import json
import math
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.loaded import load_mitsuba
from benchmarks.rooms.one_roughness import MADE, copy_files, load_tree, photograph, pinhole, views_of
from neurad.core.camera import facing
from neurad.core.records import Float64Array
from neurad.core.scene_records import EnvironmentMap
from neurad.formats.mitsuba.read import read_xml
from neurad.images.image_io import write_exr

MEAN = 0.25
"""Mean radiance of a photograph."""
GROUND = 0.2
"""Reflectance of the ground outside."""
PROBE_SPP = 64
"""Samples a pixel of the pictures by which the day's brightness is chosen."""


def main() -> None:
    """Write DST."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("source", type=Path, metavar="SRC", help="room folder with scene.xml and transforms_*.json")
    parser.add_argument("folder", type=Path, metavar="DST", help="room folder to write, or to go on with")
    parser.add_argument("--towards-sun", type=float, nargs=3, required=True, metavar=("X", "Y", "Z"), help="+Y is up")
    parser.add_argument("--overcast", action="store_true", help="without the sun's disk")
    parser.add_argument("--turbidity", type=float, default=3.0, help="of the air")
    parser.add_argument("--spp", type=int, default=4096, help="samples a pixel of a photograph")
    parser.add_argument("--size", type=int, help="pixels across a photograph (default: those of SRC)")
    told = "a training view more: from X Y Z towards X Y Z"
    parser.add_argument("--look", type=float, nargs=6, action="append", default=[], metavar="X", help=told)
    parser.add_argument("--seed", type=int, default=1, help="of the photographs' noise")
    asked = parser.parse_args()
    if not (asked.folder / "scene.xml").is_file():
        copy_files(asked.source, asked.folder, asked.size)
        for index, (*origin, x, y, z) in enumerate(asked.look):
            add_view(asked.folder, f"look_{index:03d}", np.array(origin), np.array((x, y, z)))
        write_scene(asked.source, asked.folder, asked.towards_sun, asked.turbidity, asked.overcast, asked.seed)
    photograph(asked.folder, asked.spp, asked.seed)


def add_view(folder: Path, name: str, origin: Float64Array, target: Float64Array) -> None:
    """A training view more in transforms_train.json, upright, from ``origin`` to ``target`` [3]."""
    path = folder / "transforms_train.json"
    cameras = json.loads(path.read_text())
    pose = facing(origin, origin - target, np.array((0.0, 1.0, 0.0)))
    files = {key: f"{Path(cameras['frames'][0][key]).parent}/{name}.exr" for key in MADE}
    cameras["frames"].append({**files, "transform_matrix": pose.tolist()})
    path.write_text(json.dumps(cameras, indent=1) + "\n")


def write_scene(
    source: Path, folder: Path, towards_sun: list[float], turbidity: float, overcast: bool, seed: int
) -> None:
    """Write scene.xml and environment.exr into a folder with the copied meshes, textures and cameras.

    Args:
        towards_sun: direction, +Y up.
        overcast: without the sun's disk.
        seed: of the noise of the pictures by which the brightness is chosen.
    """
    tree = ET.parse(source / "scene.xml")
    root = tree.getroot()
    for shape in [shape for shape in root.findall("shape") if shape.find("emitter") is not None]:
        root.remove(shape)
    for emitter in root.findall("emitter"):
        root.remove(emitter)
    day = ET.SubElement(root, "emitter", type="sunsky", id="environment")
    up = ET.SubElement(ET.SubElement(day, "transform", name="to_world"), "rotate")  # Mitsuba's sky has +Z up
    up.attrib.update(x="1", angle="-90")
    ET.SubElement(day, "vector", name="sun_direction", value=", ".join(str(x) for x in towards_sun))
    ET.SubElement(day, "float", name="turbidity", value=str(turbidity))
    ET.SubElement(day, "float", name="sun_scale", value=str(float(not overcast)))
    tree.write(folder / "day.part.xml")
    baked = read_xml(folder / "day.part.xml").environment
    (folder / "day.part.xml").unlink()
    assert baked is not None
    root.remove(day)
    sky = ET.SubElement(root, "emitter", type="envmap", id="environment")
    ET.SubElement(sky, "string", name="filename", value="environment.exr")
    matrix = " ".join(f"{x:.9g}" for x in np.asarray(baked.to_world, np.float64).ravel())
    ET.SubElement(ET.SubElement(sky, "transform", name="to_world"), "matrix", value=matrix)
    write_exr(folder / "environment.exr", with_ground(baked).pixels, half=False)
    scale = MEAN / mean_radiance(folder, tree, seed)
    write_exr(folder / "environment.exr", with_ground(baked).pixels * np.float32(scale), half=False)
    tree.write(folder / "scene.xml", encoding="utf-8", xml_declaration=True)


def with_ground(environment: EnvironmentMap) -> EnvironmentMap:
    """The map with what a diffuse ground of :data:`GROUND` reflects below the horizon."""
    pixels = environment.pixels.astype(np.float64)
    rows = len(pixels) // 2
    theta = math.pi * np.arange(rows) / (len(pixels) - 1)
    weight = np.sin(theta) * np.cos(theta) * (math.pi / (len(pixels) - 1)) * (2 * math.pi / pixels.shape[1])
    pixels[rows:] = GROUND / math.pi * (pixels[:rows] * weight[:, None, None]).sum((0, 1))
    return replace(environment, pixels=pixels.astype(np.float32))


def mean_radiance(folder: Path, tree: ET.ElementTree[ET.Element], seed: int) -> float:
    """Mean luminance of some photographs, each pixel of them at most ten times their median."""
    mi = load_mitsuba("daylight")
    scene, found = load_tree(mi, tree, folder), []
    for cameras, frame in views_of(folder)[::7]:
        picture = mi.render(scene, sensor=pinhole(mi, cameras, frame), spp=PROBE_SPP, seed=seed).numpy().mean(-1)
        found.append(np.minimum(picture, 10.0 * np.median(picture)).mean())
    return float(np.mean(found))


if __name__ == "__main__":
    main()
