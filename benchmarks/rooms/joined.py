"""``python -m benchmarks.rooms.joined SRC DST``: a room as a scanner has it, all its meshes one, of one grey material.

Nothing is said of its lamps. With ``--run RUN``, a fit of DST, what that run found of them is printed as a table.
"""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

import neurad
from neurad.core.records import Float64Array, FloatArray
from neurad.core.scene_records import Mesh
from neurad.export.charts import triangle_areas
from neurad.formats.load import load_scene
from neurad.formats.meshes.ply import write_ply
from neurad.images.image_io import write_exr
from neurad.images.photographs import read_view
from neurad.lamps.scores import lamp_error
from neurad.runtime.tables import align
from neurad.scene.description import Scene
from neurad.scene.triangles import merged

SCENE = """<scene version="3.0.0">
	<integrator type="path">
		<integer name="max_depth" value="{depth}" /><integer name="rr_depth" value="{rr}" />
	</integrator>
	<bsdf type="twosided" id="grey"><bsdf type="principled">
		<rgb name="base_color" value="0.5, 0.5, 0.5" /><float name="roughness" value="0.5" />
	</bsdf></bsdf>
	<shape type="ply" id="scan"><string name="filename" value="scan.ply" /><ref id="grey" /></shape>
{lamps}</scene>
"""
"""The scene file of DST."""
LAMP = """	<shape type="ply" id="{name}"><string name="filename" value="{name}.ply" />
		<bsdf type="twosided"><bsdf type="principled">
			<rgb name="base_color" value="0.02, 0.02, 0.02" /><float name="roughness" value="0.5" />
		</bsdf></bsdf>
		<emitter type="area"><rgb name="radiance" value="{radiance}" /></emitter>
	</shape>
"""
HEADINGS = ("lamp", "area found", "beside it", "pixels", "radiance", "found", "error", "power error")
"""Of the table: fractions of the lamp's area, and largest relative errors of a channel."""


def main() -> None:
    """Write DST, or print what a run of it found."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("source", type=Path, metavar="SRC", help="room folder with its lamps")
    parser.add_argument("folder", type=Path, metavar="DST", help="room folder to write")
    parser.add_argument("--run", help="folder of a fit of DST, which is there")
    parser.add_argument("--known", action="store_true", help="leave lamps out of the one mesh, as bright as they are")
    parser.add_argument(
        "--clip", type=float, metavar="QUANTILE", help="clip all photographs at this quantile of all values"
    )
    asked = parser.parse_args()
    scene = load_scene(str(asked.source), None)
    if asked.run:
        print(*align(found_by(scene, asked.run, asked.folder)), sep="\n")
    else:
        join_room(scene, asked.source, asked.folder, asked.known)
        if asked.clip is not None:
            print(f"--data.ceiling {clip_photographs(scene, asked.folder, asked.clip)}")


def joined(meshes: Sequence[Mesh]) -> Mesh:
    """Meshes as one, with normals where they have some and those of their triangles elsewhere."""
    vertices, faces, _ = merged(meshes)
    normals = np.concatenate([_normals(mesh) for mesh in meshes])
    return Mesh("scan", vertices.astype(np.float32), faces, 0, normals.astype(np.float32))


def _normals(mesh: Mesh) -> Float64Array:
    if mesh.normals is not None:
        return mesh.normals.astype(np.float64)
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces].astype(np.float64), 1, 0)
    normals = np.zeros(mesh.vertices.shape)
    np.add.at(normals, mesh.faces, np.cross(b - a, c - a)[:, None])
    found: Float64Array = normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-30)
    return found


def join_room(scene: Scene, source: Path, folder: Path, known: bool) -> None:
    """Write the scanned room, with links to what stays as it is."""
    folder.mkdir(parents=True)
    lamps = [mesh for mesh in scene.meshes if mesh.radiance is not None] if known else []
    write_ply(folder / "scan.ply", joined([mesh for mesh in scene.meshes if not known or mesh.radiance is None]))
    for mesh in lamps:
        write_ply(folder / f"{mesh.name}.ply", mesh)
    shapes = "".join(LAMP.format(name=mesh.name, radiance=_three(mesh.radiance)) for mesh in lamps)
    (folder / "scene.xml").write_text(SCENE.format(depth=scene.max_depth, rr=scene.rr_depth, lamps=shapes))
    for path in source.iterdir():
        if path.name.startswith("transforms"):
            shutil.copyfile(path, folder / path.name)
        elif path.name in ("images", "albedo", "roughness", "metallic"):
            (folder / path.name).symlink_to(path.resolve())


def clip_photographs(scene: Scene, folder: Path, quantile: float) -> float:
    """Put training photographs in place that end at a quantile of all values; that value."""
    photographs = [read_view(view) for view in scene.train]
    ceiling = float(np.quantile(np.stack(photographs), quantile).astype(np.float16))
    (folder / "images").unlink()
    shutil.copytree(Path(str(scene.train[0].image)).parent, folder / "images", copy_function=shutil.copyfile)
    for view, pixels in zip(scene.train, photographs, strict=True):
        write_exr(folder / "images" / Path(str(view.image)).name, np.minimum(pixels, ceiling))
    return ceiling


def found_by(scene: Scene, run_folder: str, root: Path) -> list[list[str]]:
    """A row for each lamp of the scene that was joined, and for each that the run found and is none."""
    run = neurad.load(run_folder, str(root))
    lamps, geometry = run.assembly.lamps, run.world.geometry
    assert lamps is not None
    corners = np.concatenate([mesh.vertices[mesh.faces] for mesh in scene.meshes])
    of = np.repeat(np.arange(len(scene.meshes)), [len(mesh.faces) for mesh in scene.meshes])
    shining = torch.unique(lamps.lit).cpu()
    lit = geometry.vertices[geometry.faces[shining]].cpu().numpy()
    numbers = {_key(triangle): int(number) for triangle, number in zip(lit, lamps.lamp[shining], strict=True)}
    lamp = np.array([numbers.get(_key(triangle), -1) for triangle in corners])  # -1: of none
    area = triangle_areas(corners)
    radiance, counts = lamps.found(), lamps.counts.cpu().numpy()
    table, claimed = [list(HEADINGS)], np.zeros(len(of), bool)
    for index, mesh in enumerate(scene.meshes):
        if mesh.radiance is None:
            continue
        inside = of == index
        pieces = [piece for piece in range(len(radiance)) if area[inside & (lamp == piece)].sum() > 0]
        mine = np.isin(lamp, pieces)
        claimed |= mine
        truth = mesh.radiance.astype(np.float64)
        power = sum((area[lamp == piece].sum() * radiance[piece] for piece in pieces), np.zeros(3))
        largest = max(pieces, key=lambda piece: area[lamp == piece].sum(), default=None)
        mean = np.zeros(3) if largest is None else radiance[largest]
        whole = area[inside].sum()
        table.append([
            mesh.name, f"{area[inside & mine].sum() / whole:.4f}", f"{area[mine & ~inside].sum() / whole:.4f}",
            str(counts[pieces, 0].sum()), _three(truth), _three(mean),
            *(f"{lamp_error(value[None], truth[None])[0]:.4f}" for value in (mean, power / whole)),
        ])  # fmt: skip
    for piece in np.unique(lamp[(lamp >= 0) & ~claimed]):
        names = sorted({scene.meshes[index].name for index in np.unique(of[lamp == piece])})
        table.append([
            f"none ({', '.join(names)})", "", f"{area[lamp == piece].sum():.4g} of area", str(counts[piece, 0]), "",
            _three(radiance[piece]), "", "",
        ])  # fmt: skip
    return table


def _key(triangle: FloatArray) -> bytes:
    """What equal triangles share, whatever their first corner."""
    places = np.asarray(triangle, np.float32)
    return places[np.lexsort(places.T)].tobytes()


def _three(values: FloatArray | Float64Array | None) -> str:
    return ", ".join(f"{x:.4g}" for x in np.asarray(values))


if __name__ == "__main__":
    main()
