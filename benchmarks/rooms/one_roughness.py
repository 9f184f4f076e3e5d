"""``python -m benchmarks.rooms.one_roughness SRC DST``: a room folder in which each material has one roughness.

Mitsuba photographs the room again by the cameras of SRC, with the integrator of its scene.xml. Views that are there
already are kept, so that a call goes on where another one ended.
"""

from __future__ import annotations

import argparse
import json
import shutil
import xml.etree.ElementTree as ET
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.loaded import load_mitsuba
from neurad.images.image_io import read_bitmap, write_exr

LOWEST_MEAN, HIGHEST_MEAN = 0.1, 0.9
"""Bounds of a roughness that is the mean of a map."""
LOWEST_DRAWN, HIGHEST_DRAWN = 0.15, 0.85
"""Bounds of a roughness that is drawn."""
MIN_DEVIATION = 0.05
"""Standard deviation of the maps' means below which materials are alike, and get values that are drawn."""
SPLITS = ("train", "test")
MADE = ("file_path", "albedo_path", "roughness_path")
"""Files of a view that are made."""
MAP_SPP = 64
"""Samples a pixel of the true maps."""


def main() -> None:
    """Write DST."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("source", type=Path, metavar="SRC", help="room folder with scene.xml and transforms_*.json")
    parser.add_argument("folder", type=Path, metavar="DST", help="room folder to write, or to go on with")
    parser.add_argument("--spp", type=int, default=256, help="samples a pixel of a photograph")
    parser.add_argument("--all", action="store_true", help="draw the roughness of materials without a map, too")
    parser.add_argument("--size", type=int, help="pixels across a photograph (default: those of SRC)")
    parser.add_argument("--seed", type=int, default=1, help="of what is drawn, and of the photographs' noise")
    asked = parser.parse_args()
    copy_room(asked.source, asked.folder, asked.seed, asked.size, asked.all)
    photograph(asked.folder, asked.spp, asked.seed)


def copy_room(source: Path, folder: Path, seed: int, size: int | None = None, every: bool = False) -> None:
    """Copy what stays, and write scene.xml with a number for each roughness map, and cameras ``size`` pixels wide.

    A number is its map's mean, or where the means are alike one that is drawn from the seed and the material's name;
    with ``every`` the roughness of each material is drawn.
    """
    copy_files(source, folder, size)
    if (source / "LICENSE.txt").is_file():
        shutil.copy(source / "LICENSE.txt", folder)
    scene = ET.parse(source / "scene.xml")
    found: dict[str, tuple[ET.Element, ET.Element]] = {}
    for material in scene.getroot().findall("bsdf"):
        for shader in material.iter("bsdf"):
            for rough in shader.findall("./*[@name='roughness']"):
                if every or rough.tag == "texture":
                    found[material.attrib["id"]] = shader, rough
    means = {name: _mean(source, rough) for name, (_, rough) in found.items()}
    draw = every or (len(means) > 1 and float(np.std(list(means.values()))) < MIN_DEVIATION)
    for name, (shader, rough) in found.items():
        drawn = np.random.default_rng([seed, zlib.crc32(name.encode())]).uniform(LOWEST_DRAWN, HIGHEST_DRAWN)
        value = drawn if draw else float(np.clip(means[name], LOWEST_MEAN, HIGHEST_MEAN))
        shader[list(shader).index(rough)] = ET.Element("float", name="roughness", value=f"{value:.6g}")
        if rough.tag == "texture":
            (folder / _file(rough)).unlink(missing_ok=True)
        print(f"{name}: roughness {value:.3f}, before {means[name]:.3f} in the mean", flush=True)
    scene.write(folder / "scene.xml", encoding="utf-8", xml_declaration=True)


def copy_files(source: Path, folder: Path, size: int | None) -> None:
    """Copy meshes, textures and the cameras of all views, ``size`` pixels wide, without files that :func:`photograph`
    does not make.
    """
    folder.mkdir(exist_ok=True)
    for name in ("meshes", "textures"):
        if (source / name).is_dir():
            shutil.copytree(source / name, folder / name, dirs_exist_ok=True)
    for name in (f"transforms_{split}.json" for split in SPLITS):
        cameras = json.loads((source / name).read_text())
        scale = 1.0 if size is None else size / cameras["w"]
        cameras |= {key: cameras[key] * scale for key in ("fl_x", "fl_y", "cx", "cy")}
        cameras |= {key: round(cameras[key] * scale) for key in ("w", "h")}
        for frame in cameras["frames"]:
            for key in [key for key in frame if key.endswith("_path") and key not in MADE]:
                del frame[key]
        (folder / name).write_text(json.dumps(cameras, indent=1) + "\n")


def _mean(source: Path, rough: ET.Element) -> float:
    if rough.tag == "float":
        return float(rough.attrib["value"])
    return float(read_bitmap(source / _file(rough), raw=True).mean())


def _file(texture: ET.Element) -> str:
    return next(child.attrib["value"] for child in texture if child.attrib["name"] == "filename")


def photograph(folder: Path, spp: int, seed: int) -> None:
    """Photographs of ``spp`` samples a pixel and true maps of all views that lack them; Mitsuba reads scene.xml."""
    mi = load_mitsuba("one_roughness")
    scene = mi.load_file(str(folder / "scene.xml"))
    subjects = {"albedo": scene, "roughness": roughness_scene(mi, folder / "scene.xml")}
    aov = mi.load_dict({"type": "aov", "aovs": "value:albedo"})
    for index, (cameras, frame) in enumerate(views_of(folder), seed + 1):
        picture = folder / frame["file_path"]
        if picture.is_file():
            continue
        sensor = pinhole(mi, cameras, frame)
        for kind, subject in subjects.items():
            values = mi.render(subject, sensor=sensor, integrator=aov, spp=MAP_SPP, seed=index).numpy()
            file = folder / frame[f"{kind}_path"]
            file.parent.mkdir(exist_ok=True)
            write_exr(file, values[..., -3:] if kind == "albedo" else values[..., -3:-2])
        picture.parent.mkdir(exist_ok=True)
        write_exr(picture, mi.render(scene, sensor=sensor, spp=spp, seed=index).numpy())
        print(frame["file_path"], flush=True)


def views_of(folder: Path) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """Camera file and frame of each view of a room folder."""
    files = [json.loads((folder / f"transforms_{split}.json").read_text()) for split in SPLITS]
    return [(cameras, frame) for cameras in files for frame in cameras["frames"]]


def pinhole(mi: Any, cameras: dict[str, Any], frame: dict[str, Any]) -> Any:
    """Mitsuba's sensor of a frame of transforms_*.json, with square pixels, a centred axis and a box filter."""
    to_world = np.array(frame["transform_matrix"]) @ np.diag([-1.0, 1.0, -1.0, 1.0])
    film = {"type": "hdrfilm", "width": cameras["w"], "height": cameras["h"], "pixel_format": "rgb"}
    return mi.load_dict({
        "type": "perspective", "fov": float(np.degrees(cameras["camera_angle_x"])), "fov_axis": "x",
        "to_world": mi.ScalarTransform4f(to_world), "film": {**film, "rfilter": {"type": "box"}},
        "sampler": {"type": "independent"},
    })  # fmt: skip


def roughness_scene(mi: Any, path: Path) -> Any:
    """The scene, its roughness as the reflectance of diffuse materials, which Mitsuba's integrator ``aov`` shows."""
    tree = ET.parse(path)
    for shader in (shader for material in tree.getroot().findall("bsdf") for shader in material.iter("bsdf")):
        rough = next((child for child in shader if child.attrib.get("name") == "roughness"), None)
        if rough is None:
            continue
        for child in list(shader):
            shader.remove(child)
        if rough.tag == "float":
            value = rough.attrib["value"]
            rough = ET.Element("rgb", value=f"{value}, {value}, {value}")
        rough.attrib["name"] = "reflectance"
        shader.attrib["type"] = "diffuse"
        shader.append(rough)
    return load_tree(mi, tree, path.parent)


def load_tree(mi: Any, tree: ET.ElementTree[ET.Element], folder: Path) -> Any:
    """A tree as Mitsuba loads it from a file in the room's folder, which does not stay."""
    written = folder / "written.part.xml"
    tree.write(written)
    try:
        return mi.load_file(str(written))
    finally:
        written.unlink()


if __name__ == "__main__":
    main()
