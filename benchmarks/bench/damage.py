"""What is wrong with real captures, done to a room by stated amounts: its poses, its mesh and its photographs."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from PIL import Image
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from neurad.core.camera import camera_rays, fov_of, project
from neurad.core.errors import InputError
from neurad.core.records import Float64Array, FloatArray
from neurad.core.scene_records import Development, Mesh
from neurad.images.development import JPEG_CEILING
from neurad.images.image_io import to_srgb, write_exr
from neurad.images.photographs import read_view
from neurad.inspect.check.look import resampled
from neurad.runtime.extras import need
from neurad.scene.description import Scene
from neurad.scene.flatten import flattened
from neurad.scene.holes import close_holes
from neurad.scene.triangles import normals_and_areas

EDGE = 0.1
"""Longest edge in metres of a mesh that is bent or has holes, as in the scan of a phone."""
WAVE, GRAIN = 0.5, 0.1
"""Wavelength of waves and distance between independent displacements of noise, in metres."""
HOLE, CLOSED = 0.1, 0.4
"""Radius of a hole, and width up to which holes are closed again, in metres."""
WHITE = 0.9
"""Value that the brightest of the photographs' pixels but one in a hundred get before they become codes."""
K1 = 0.02
"""Radial distortion that the photographs have and the cameras do not say."""
FOCAL = 1.01
"""Times the true focal length that cameras say."""
QUALITY = 90
"""Of JPEG files."""
STOP = 0.5
"""Largest change of exposure, in stops."""


@dataclass
class Capture:
    """A room as somebody captured it: its scene, and the photographs of its training views."""

    scene: Scene
    """With the poses, meshes and settings that a fit is given."""
    photographs: list[FloatArray]
    """Linear radiance [h, w, 3]."""
    rng: np.random.Generator
    metre: float = 1.0
    """Scene units in a metre."""
    coded: bool = False
    """Whether photographs are JPEG files."""

    def __post_init__(self) -> None:
        """Remember which cameras took the photographs."""
        self.right = [view.camera for view in self.scene.train]

    def with_meshes(self, change: Callable[[Mesh], Mesh]) -> None:
        """Change every mesh that does not shine: lamps are known."""
        meshes = [mesh if mesh.radiance is not None else change(mesh) for mesh in self.scene.meshes]
        self.scene = replace(self.scene, meshes=meshes)

    @property
    def white(self) -> float:
        """Value that one in a hundred of the photographs' values is above."""
        return float(np.quantile(np.concatenate([image.ravel() for image in self.photographs]), 0.99))

    def written(self, folder: Path, side: int) -> Scene:
        """The scene with its photographs in a folder; its mesh is refined as when a fit reads it.

        Args:
            folder: that exists.
            side: width of the photographs in pixels.
        """
        white, train = self.white, []
        for number, (view, image) in enumerate(zip(self.scene.train, self.photographs, strict=True)):
            height = round(view.camera.height * side / view.camera.width)
            pixels = resampled(image, (height, side))
            path = folder / f"{number:04d}{'.jpg' if self.coded else '.exr'}"
            development = Development()
            if self.coded:
                codes = np.round(255.0 * to_srgb(pixels * np.float32(WHITE / white))).astype(np.uint8)
                Image.fromarray(codes).save(path, quality=QUALITY)
                development = Development("srgb", 255, JPEG_CEILING, WHITE / white)
            else:
                write_exr(path, pixels)
            camera = replace(view.camera, width=side, height=height)
            train.append(replace(view, camera=camera, image=str(path), development=development, maps={}))
        return flattened(replace(self.scene, train=train))


def captured(scene: Scene, seed: int, metre: float = 1.0) -> Capture:
    """The room as it is.

    Args:
        scene: with photographs, without masks.
        seed: of what is damaged at random.
        metre: scene units in a metre.

    Raises:
        InputError: a training view has no photograph, or has a mask or alpha.
    """
    photographs = []
    for view in scene.train:
        if view.image is None or view.mask is not None:
            raise InputError(f"view {view.name}: this takes training views with photographs and without masks")
        photographs.append(read_view(view))
        if photographs[-1].shape[2] != 3:
            raise InputError(f"view {view.name}: its photograph has alpha; this takes rooms, photographed whole")
    return Capture(scene, photographs, np.random.default_rng(seed), metre)


# ---- poses


def turn_cameras(capture: Capture, degrees: float, mm: float) -> None:
    """Turn each training camera by so much about a random axis through its place, and move it by so much."""
    views = []
    for view in capture.scene.train:
        axis, way = capture.rng.normal(size=(2, 3))
        pose: Any = np.asarray(view.camera.to_world, np.float64).copy()
        turn = Rotation.from_rotvec(math.radians(degrees) * axis / np.linalg.norm(axis)).as_matrix()
        pose[:3, :3] = turn @ pose[:3, :3]
        pose[:3, 3] += 1e-3 * mm * capture.metre * way / np.linalg.norm(way)
        views.append(replace(view, camera=replace(view.camera, to_world=pose)))
    capture.scene = replace(capture.scene, train=views)


def distort(capture: Capture) -> None:
    """Give the photographs the radial distortion :data:`K1`; the cameras stay without."""
    for index, (view, image) in enumerate(zip(capture.scene.train, capture.photographs, strict=True)):
        lens = replace(view.camera.lens, numerator=(K1,))
        camera = replace(view.camera, to_world=np.eye(4, dtype=np.float32))
        h, w = image.shape[:2]
        y, x = torch.meshgrid(torch.arange(h) + 0.5, torch.arange(w) + 0.5, indexing="ij")
        rays = camera_rays(replace(camera, lens=lens), torch.stack((x, y), -1).view(-1, 2).double())
        place = project(camera, rays.d)
        grid = (2.0 * place / torch.tensor([w, h]) - 1.0).view(1, h, w, 2).float()
        source = torch.from_numpy(image).movedim(-1, 0)[None]
        bent = torch.nn.functional.grid_sample(source, grid, padding_mode="border", align_corners=False)
        capture.right[index] = replace(capture.right[index], lens=lens)
        capture.photographs[index] = bent[0].movedim(0, -1).contiguous().numpy()


def change_focal_length(capture: Capture) -> None:
    """Say a focal length of all training cameras that is off by :data:`FOCAL`."""
    views = []
    for view in capture.scene.train:
        fov_x = fov_of(FOCAL * view.camera.fl_x, view.camera.width)
        views.append(replace(view, camera=replace(view.camera, fov_x=fov_x)))
    capture.scene = replace(capture.scene, train=views)


# ---- the mesh


def divided(mesh: Mesh, longest: float) -> Mesh:
    """The mesh with longest edges halved until none is longer: slivers stay few, and neighbours fit together."""
    names = [name for name in ("normals", "uvs") if getattr(mesh, name) is not None]
    parts = [mesh.vertices, *(getattr(mesh, name) for name in names), *mesh.attributes.values()]
    values, faces = np.concatenate(parts, -1).astype(np.float64), mesh.faces
    while True:
        corners = values[faces, :3]
        length = np.linalg.norm(np.roll(corners, -1, 1) - corners, axis=-1)
        long = length.max(1) > longest
        if not long.any():
            break
        first = length[long].argmax(1)[:, None]
        a, b, c = np.take_along_axis(faces[long], (first + np.arange(3)) % 3, 1).T
        edges, index = np.unique(np.sort(np.stack((a, b), -1), -1), axis=0, return_inverse=True)
        middle = len(values) + index.reshape(-1)
        values = np.concatenate((values, values[edges].mean(1)))
        faces = np.concatenate((faces[~long], np.stack((a, middle, c), -1), np.stack((middle, b, c), -1)))
    single = values.astype(np.float32)
    split = np.split(single, np.cumsum([part.shape[1] for part in parts])[:-1], -1)
    rest = dict(zip([*names, *mesh.attributes], split[1:], strict=True))
    normals, uvs = (rest.pop(name, None) for name in ("normals", "uvs"))
    return replace(mesh, vertices=split[0], faces=faces.astype(np.int64), normals=normals, uvs=uvs, attributes=rest)


def _displaced(mesh: Mesh, field: Callable[[Float64Array], Float64Array], step: float) -> Mesh:
    """A mesh moved by a field of displacements, with normals turned as its surface is.

    Args:
        mesh: fine enough for the field.
        field: displacements [n, 3] at places [n, 3]: where meshes touch they stay together.
        step: distance over which the field is differentiated.
    """
    p = np.asarray(mesh.vertices, np.float64)
    normals = mesh.normals
    if normals is not None:
        # A plane's normal n becomes (1 + J)^-T n, to first order n - J^T n.
        slope = [(field(p + step * axis) - field(p - step * axis)) / (2.0 * step) for axis in np.eye(3)]
        turned = normals - np.stack([(column * normals).sum(-1) for column in slope], -1)
        normals = (turned / np.linalg.norm(turned, axis=-1, keepdims=True)).astype(np.float32)
    return replace(mesh, vertices=(p + field(p)).astype(np.float32), normals=normals)


def wave_mesh(capture: Capture, mm: float) -> None:
    """Bend all surfaces in waves of this amplitude."""
    phase, metre = capture.rng.uniform(0.0, 2.0 * math.pi, 3), capture.metre

    def field(p: Float64Array) -> Float64Array:
        return np.asarray(1e-3 * mm * metre * np.sin(2.0 * math.pi / (WAVE * metre) * p[:, [1, 2, 0]] + phase))

    capture.with_meshes(lambda mesh: _displaced(divided(mesh, EDGE * metre), field, 0.1 * WAVE * metre))


def roughen_mesh(capture: Capture, mm: float) -> None:
    """Move surfaces at random by this standard deviation, independently at places :data:`GRAIN` apart."""
    cell, metre = GRAIN * capture.metre, capture.metre
    low, high = np.asarray(capture.scene.bounds, np.float64)
    size = np.ceil((high - low) / cell).astype(int) + 3
    lattice = capture.rng.normal(scale=1e-3 * mm * metre, size=(*size, 3)).astype(np.float32)

    def field(p: Float64Array) -> Float64Array:
        at = (p - low) / cell + 1.0
        between = at - np.floor(at)
        kept = np.sqrt(
            (between**2 + (1.0 - between) ** 2).prod(-1, keepdims=True)
        )  # of the deviation, by interpolation
        made = [map_coordinates(lattice[..., i], at.T, order=1, mode="nearest") for i in range(3)]
        return np.asarray(np.stack(made, -1) / kept)

    capture.with_meshes(lambda mesh: _displaced(divided(mesh, EDGE * metre), field, 0.25 * cell))


def pierce_mesh(capture: Capture, fraction: float) -> None:
    """Take away round holes of :data:`HOLE` until this fraction of the area is gone."""
    capture.with_meshes(lambda mesh: divided(mesh, EDGE * capture.metre))
    dark = [mesh for mesh in capture.scene.meshes if mesh.radiance is None]
    corners = np.concatenate([mesh.vertices[mesh.faces] for mesh in dark]).astype(np.float64)
    area = normals_and_areas(corners)[1]
    middle = corners.mean(1)
    tree, gone = cKDTree(middle), np.zeros(len(area), bool)
    while area[gone].sum() < fraction * area.sum():
        centre = middle[capture.rng.choice(len(area), p=area / area.sum())]
        gone[tree.query_ball_point(centre, HOLE * capture.metre)] = True
    starts = iter(np.cumsum([0, *(len(mesh.faces) for mesh in dark)]))

    def pierced(mesh: Mesh) -> Mesh:
        first = next(starts)
        return replace(mesh, faces=mesh.faces[~gone[first : first + len(mesh.faces)]])

    capture.with_meshes(pierced)
    capture.scene = replace(capture.scene, meshes=[mesh for mesh in capture.scene.meshes if len(mesh.faces)])


def close_mesh(capture: Capture) -> None:
    """Close holes as ``neurad data --close-holes`` does."""
    meshes = close_holes(capture.scene.meshes, CLOSED * capture.metre).meshes
    capture.scene = replace(capture.scene, meshes=meshes)


def decimate_mesh(capture: Capture, fraction: float) -> None:
    """Leave this fraction of the triangles of each mesh of a scan, by quadric error: triangles as large as a wall would
    go with the wall.

    Raises:
        InputError: open3d is missing.
    """
    need("open3d", "open3d", "decimation of meshes")
    capture.with_meshes(lambda mesh: _decimated(divided(mesh, EDGE * capture.metre), fraction))


def _decimated(mesh: Mesh, fraction: float) -> Mesh:
    import open3d

    places, index = np.unique(np.asarray(mesh.vertices, np.float64), axis=0, return_inverse=True)
    source = open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector(places), open3d.utility.Vector3iVector(index.reshape(-1)[mesh.faces])
    )
    made = source.simplify_quadric_decimation(max(4, round(fraction * len(mesh.faces))))
    whole = trimesh.Trimesh(np.asarray(made.vertices), np.asarray(made.triangles), process=False)
    if len(whole.faces) == 0:
        return mesh
    if mesh.normals is not None:
        whole = trimesh.graph.smooth_shade(whole, math.radians(30.0))
    nearest = cKDTree(mesh.vertices).query(whole.vertices)[1]
    return replace(
        mesh, vertices=np.asarray(whole.vertices, np.float32), faces=np.asarray(whole.faces, np.int64),
        normals=None if mesh.normals is None else np.asarray(whole.vertex_normals, np.float32),
        uvs=None if mesh.uvs is None else mesh.uvs[nearest],
        attributes={name: values[nearest] for name, values in mesh.attributes.items()},
    )  # fmt: skip


# ---- the photographs


def change_exposures(capture: Capture, fitted: bool = False) -> None:
    """Change the exposure of each photograph by up to :data:`STOP` to both sides, and say nothing of it.

    Args:
        capture: the room.
        fitted: let the fit recover the exposures.
    """
    gains = 2.0 ** capture.rng.uniform(-STOP, STOP, len(capture.photographs))
    gains /= np.exp(np.log(gains).mean())
    capture.photographs = [image * np.float32(gain) for image, gain in zip(capture.photographs, gains, strict=True)]
    if fitted:
        photography = replace(capture.scene.photography, exposure="fit")
        capture.scene = replace(capture.scene, photography=photography)


def compress(capture: Capture) -> None:
    """Save photographs as JPEG of :data:`QUALITY`, in one exposure that is known."""
    capture.coded = True


DAMAGES: dict[str, tuple[Callable[[Capture], None], ...]] = {
    "nothing": (),
    "poses 0.1 degrees and 2 mm": (partial(turn_cameras, degrees=0.1, mm=2.0),),
    "poses 0.3 degrees and 5 mm": (partial(turn_cameras, degrees=0.3, mm=5.0),),
    "poses 1 degree and 20 mm": (partial(turn_cameras, degrees=1.0, mm=20.0),),
    "k1 = 0.02 ignored": (distort,),
    "focal lengths 1 % off": (change_focal_length,),
    "mesh waves of 2 mm": (partial(wave_mesh, mm=2.0),),
    "mesh waves of 5 mm": (partial(wave_mesh, mm=5.0),),
    "mesh waves of 10 mm": (partial(wave_mesh, mm=10.0),),
    "mesh noise of 2 mm": (partial(roughen_mesh, mm=2.0),),
    "mesh noise of 5 mm": (partial(roughen_mesh, mm=5.0),),
    "mesh noise of 10 mm": (partial(roughen_mesh, mm=10.0),),
    "holes in 2 % of the mesh": (partial(pierce_mesh, fraction=0.02),),
    "holes in 2 % of the mesh, closed": (partial(pierce_mesh, fraction=0.02), close_mesh),
    "mesh waves of 5 mm, holes in 2 %, closed": (
        partial(wave_mesh, mm=5.0), partial(pierce_mesh, fraction=0.02), close_mesh,
    ),
    "mesh decimated to 20 %": (partial(decimate_mesh, fraction=0.2),),
    "JPEG 90": (compress,),
    "exposures +-0.5 EV, not told": (change_exposures,),
    "exposures +-0.5 EV, fitted": (partial(change_exposures, fitted=True),),
    "0.3 degrees, waves of 5 mm, holes, JPEG, +-0.5 EV fitted": (
        partial(turn_cameras, degrees=0.3, mm=5.0), partial(wave_mesh, mm=5.0), partial(pierce_mesh, fraction=0.02),
        partial(change_exposures, fitted=True), compress,
    ),
    "the same, holes closed": (
        partial(turn_cameras, degrees=0.3, mm=5.0), partial(wave_mesh, mm=5.0), partial(pierce_mesh, fraction=0.02),
        close_mesh, partial(change_exposures, fitted=True), compress,
    ),
}  # fmt: skip
"""What is done to a room, by what a table says of it."""
