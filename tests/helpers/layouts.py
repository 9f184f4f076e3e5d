"""A room's cameras, photographs and mesh, written as other programs write them, by their own conventions."""

import json
import math
import struct
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from neurad.core.camera import fov_of
from neurad.core.lens import Lens
from neurad.core.scene_records import Camera
from neurad.images.image_io import write_exr

MTL = "newmtl Wände\nKd 0.5 0.5 0.5\nnewmtl lamp 1\nKe 3 2 1\n"
OBJ = """mtllib room.mtl
v -2 0 -2
v 2 0 -2
v 2 0 2
v -2 0 2
v -1 3 -1
v 1 3 -1
v 1 3 1
v -1 3 1
usemtl Wände
f 4 3 2 1
usemtl lamp 1
f 5 6 7
f 5 7 8
"""
"""A floor of one polygon, and a lamp of two triangles that shines down."""

LENSES = {
    "pinhole": Lens(),
    "off-centre": Lens(1.05, (0.45, 0.55)),
    "opencv": Lens(1.02, (0.48, 0.51), (-0.2, 0.03), (), (1e-3, -2e-3)),
    "fisheye": Lens(1.0, (0.5, 0.5), (0.02, -0.003, 0.001, -1e-4), fisheye=True),
    "full": Lens(1.0, (0.5, 0.52), (-0.2, 0.03, 0.002), (0.01, 0.002), (1e-3, 0.0)),
    "radial": Lens(1.0, (0.47, 0.5), (-0.1, 0.02)),
}
SIZES = [(12, 9), (10, 14)]


def cameras(lens: str = "pinhole", count: int = 10) -> list[Camera]:
    """Cameras around the room, of two sizes, with axes in all directions."""
    made = []
    rng = np.random.default_rng(4)
    for index in range(count):
        width, height = SIZES[index % 2]
        pose = np.eye(4)
        pose[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        pose[:3, :3] *= np.linalg.det(pose[:3, :3])
        pose[:3, 3] = rng.uniform((-1, 0.5, -1), (1, 2.5, 1))
        made.append(Camera(pose, fov_of(9.0 + index / 8, width), width, height, LENSES[lens]))
    return made


def noise(path: Path, camera: Camera, kind: str, index: int) -> None:
    """A photograph, or a map, of nothing but noise."""
    path.parent.mkdir(parents=True, exist_ok=True)
    seed = index + {"image": 0, "albedo": 100, "roughness": 200}[kind]
    shape = (camera.height, camera.width, 3)
    write_exr(path, np.random.default_rng(seed).random(shape, np.float32), half=False)


def write_mesh(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "room.mtl").write_text(MTL)
    (folder / "room.obj").write_text(OBJ)
    return folder / "room.obj"


def coefficients(lens: Lens) -> dict[str, float]:
    k = {f"k{i + 1}": x for i, x in enumerate(lens.numerator)} | {
        f"k{i + 4}": x for i, x in enumerate(lens.denominator)
    }
    return {**k, "p1": lens.tangential[0], "p2": lens.tangential[1]}


# ---- nerfstudio


def write_nerfstudio(folder: Path, made: list[Camera]) -> Path:
    """As ``ns-process-data`` does: one file, the frame turned and scaled, which it says."""
    turn = np.array([[1.0, 0, 0, 0.3], [0, 0, 1, -0.1], [0, -1, 0, 0.2], [0, 0, 0, 1]])
    frames = []
    for index, camera in enumerate(made):
        name = f"images/frame_{index:05d}.exr"
        noise(folder / name, camera, "image", index)
        moved = turn @ camera.to_world
        moved[:3, 3] *= 0.25
        frames.append({
            "file_path": name, "transform_matrix": moved.tolist(), "w": camera.width, "h": camera.height,
            "fl_x": camera.fl_x, "fl_y": camera.fl_y, "cx": camera.cx, "cy": camera.cy, "colmap_im_id": index,
        })  # fmt: skip
    lens = made[0].lens
    model = "OPENCV_FISHEYE" if lens.fisheye else "FULL_OPENCV" if lens.denominator else "OPENCV"
    described = {
        "camera_model": model, **coefficients(lens), "applied_transform": turn[:3].tolist(), "applied_scale": 0.25,
        "ply_file_path": "sparse_pc.ply", "frames": frames,
    }  # fmt: skip
    (folder / "transforms.json").write_text(json.dumps(described))
    return folder


# ---- COLMAP

NUMBERS = {"SIMPLE_PINHOLE": 0, "PINHOLE": 1, "SIMPLE_RADIAL": 2, "RADIAL": 3, "OPENCV": 4, "OPENCV_FISHEYE": 5,
           "FULL_OPENCV": 6, "SIMPLE_RADIAL_FISHEYE": 8, "RADIAL_FISHEYE": 9}  # fmt: skip


def colmap_line(camera: Camera) -> tuple[str, list[float]]:
    """Model and parameters, in COLMAP's order."""
    lens, k = camera.lens, {**dict.fromkeys(("k2", "k3", "k4", "k5", "k6"), 0.0), **coefficients(camera.lens)}
    two = [camera.fl_x, camera.fl_y, camera.cx, camera.cy]
    if lens.fisheye:
        return "OPENCV_FISHEYE", [*two, *(k[f"k{i}"] for i in (1, 2, 3, 4))]
    if lens.denominator or len(lens.numerator) > 2:
        return "FULL_OPENCV", [*two, *(k[key] for key in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"))]
    if any(lens.tangential):
        return "OPENCV", [*two, *(k[key] for key in ("k1", "k2", "p1", "p2"))]
    if lens.bends:
        return "RADIAL", [camera.fl_x, camera.cx, camera.cy, k["k1"], k["k2"]]
    return "PINHOLE", two


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """w, x, y, z."""
    return np.roll(Rotation.from_matrix(rotation).as_quat(), 1)


def colmap_pose(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Quaternion and translation from the world to a camera that looks along +Z with Y down."""
    rotation = np.diag([1.0, -1.0, -1.0]) @ camera.to_world[:3, :3].T
    return quaternion(rotation), -rotation @ camera.to_world[:3, 3]


def write_colmap(
    folder: Path, made: list[Camera], binary: bool, names: str = "IMG {:03d} ä.JPG", lenses: int = 999
) -> Path:
    """A project: ``sparse/0`` and, in ``images``, EXR files beside the names that COLMAP knows; images of the first
    ``lenses`` cameras in turn.
    """
    model = folder / "sparse/0"
    model.mkdir(parents=True)
    for index, camera in enumerate(made):
        noise((folder / "images" / names.format(index)).with_suffix(".exr"), camera, "image", index)
    if binary:
        _colmap_binary(model, made, names, lenses)
        return folder
    lines = ["# Camera list with one line of data per camera:", f"# Number of cameras: {len(made)}"]
    for index, camera in enumerate(made):
        kind, values = colmap_line(camera)
        lines.append(f"{index + 7} {kind} {camera.width} {camera.height} {' '.join(repr(float(x)) for x in values)}")
    (model / "cameras.txt").write_text("\n".join(lines) + "\n")
    lines = ["# Image list with two lines of data per image:"]
    for index, camera in enumerate(made):
        numbers = " ".join(repr(float(x)) for x in np.concatenate(colmap_pose(camera)))
        points = "" if index % 3 else "10.5 20.5 -1 30.25 40.75 12"
        lines += [f"{index + 100} {numbers} {index % lenses + 7} {names.format(index)}", points]
    (model / "images.txt").write_text("\n".join(lines) + "\n")
    return folder


def _colmap_binary(model: Path, made: list[Camera], names: str, lenses: int) -> None:
    data = struct.pack("<Q", len(made))
    for index, camera in enumerate(made):
        kind, values = colmap_line(camera)
        data += struct.pack("<iiQQ", index + 7, NUMBERS[kind], camera.width, camera.height)
        data += struct.pack(f"<{len(values)}d", *values)
    (model / "cameras.bin").write_bytes(data)
    data = struct.pack("<Q", len(made))
    for index, camera in enumerate(made):
        data += struct.pack("<i7di", index + 100, *np.concatenate(colmap_pose(camera)), index % lenses + 7)
        data += names.format(index).encode() + b"\0" + struct.pack("<Q", index % 3)
        data += struct.pack("<ddq", 1.5, 2.5, -1) * (index % 3)
    (model / "images.bin").write_bytes(data)


# ---- Polycam


def write_polycam(folder: Path, made: list[Camera]) -> Path:
    for index, camera in enumerate(made):
        name = f"{1000 + index}"
        noise(folder / f"keyframes/corrected_images/{name}.exr", camera, "image", index)
        about = {f"t_{i}{j}": float(camera.to_world[i, j]) for i in range(3) for j in range(4)}
        about |= {"fx": camera.fl_x, "fy": camera.fl_y, "cx": camera.cx, "cy": camera.cy, "blur_score": 80.5}
        path = folder / f"keyframes/corrected_cameras/{name}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps({**about, "width": camera.width, "height": camera.height, "timestamp": 1}))
    return folder


# ---- FIPT


def write_fipt_rendered(folder: Path, made: list[Camera], held_out: int = 3) -> Path:
    """Rendered rooms have one angle of view, and cameras that look along +Z with +X to the left."""
    for part, chosen in (("train", made[held_out:]), ("val", made[:held_out])):
        frames = []
        for index, camera in enumerate(chosen):
            pose = camera.to_world @ np.diag([-1.0, 1.0, -1.0, 1.0])
            frames.append({"file_path": f"./{part}/{index:03d}", "transform_matrix": pose.tolist()})
            noise(folder / part / f"Image/{index:03d}_0001.exr", camera, "image", index)
            noise(folder / part / f"DiffCol/{index:03d}_0001.exr", camera, "albedo", index)
            noise(folder / part / f"Roughness/{index:03d}_0001.exr", camera, "roughness", index)
        described = {"camera_angle_x": chosen[0].fov_x, "frames": frames}
        (folder / part / "transforms.json").write_text(json.dumps(described))
    write_mesh(folder).rename(folder / "scene.obj")
    return folder


def write_fipt_photographed(folder: Path, made: list[Camera]) -> Path:
    poses, inner = [str(len(made))], [str(len(made))]
    for index, camera in enumerate(made):
        noise(folder / f"Image/{index:03d}_0001.exr", camera, "image", index)
        eye, axes = camera.to_world[:3, 3], camera.to_world[:3, :3]
        poses += [" ".join(repr(float(x)) for x in row) for row in (eye, eye - 2.5 * axes[:, 2], axes[:, 1])]
        k = [[camera.fl_x, 0, camera.cx], [0, camera.fl_y, camera.cy], [0, 0, 1]]
        inner += [" ".join(repr(float(x)) for x in row) for row in k]
    (folder / "cam.txt").write_text("\n".join(poses) + "\n")
    (folder / "K_list.txt").write_text("\n".join(inner) + "\n")
    write_mesh(folder).rename(folder / "scene.obj")
    return folder


def one_angle(made: list[Camera]) -> list[Camera]:
    """Pinholes of one size and one angle of view, as rendered rooms have them."""
    return [Camera(camera.to_world, math.radians(70.0), *SIZES[0]) for camera in made]
