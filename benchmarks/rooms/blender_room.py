"""``python -m benchmarks.rooms.blender_room DST --blender PYTHON``: a furnished room, photographed by Cycles.

``blender_room_scene.py`` models it; ``neurad data blender`` makes the folder; true maps and a split are added to it.
"""

import argparse
import json
import subprocess
from pathlib import Path

from benchmarks.rooms.one_roughness import MAP_SPP
from neurad.assembly.build import build_world
from neurad.core.parameters import split as parts_of
from neurad.core.rng import mix
from neurad.formats.blender.import_blender import import_blender
from neurad.formats.import_room import ImportSettings
from neurad.formats.load import read_folder
from neurad.images.image_io import write_exr
from neurad.integrators.film import render
from neurad.integrators.renderer import MaterialMap
from neurad.scene.textures import TrueMaterials

SCENE = Path(__file__).with_name("blender_room_scene.py")


def main() -> None:
    """Write DST, DST.blend and the photographs in DST-photographs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, metavar="DST", help="room folder to write")
    parser.add_argument("--blender", required=True, help="a Python that has bpy")
    asked, others = parser.parse_known_args()
    blend, photographs = asked.folder.with_suffix(".blend"), asked.folder.with_name(f"{asked.folder.name}-photographs")
    ended = subprocess.run([asked.blender, str(SCENE), str(blend), str(photographs), *others], check=False)
    if ended.returncode != 0:
        raise SystemExit(ended.returncode)
    here = ImportSettings("blender", blend, asked.folder, images=photographs, copy=True, blender=asked.blender)
    import_blender(here)
    add_truth(asked.folder)


def add_truth(folder: Path) -> None:
    """Write true maps of all views, and list them and the split, by the views' names, in transforms.json."""
    cameras = folder / "transforms.json"
    described = json.loads(cameras.read_text())
    files = [frame["file_path"] for frame in described["frames"]]
    for kind in ("train", "test"):
        described[f"{kind}_filenames"] = [file for file in files if Path(file).name.startswith(kind)]
    scene = read_folder(folder, hold_out=0)
    world = build_world(scene)
    maps = MaterialMap(world, TrueMaterials(scene, world.geometry), scene.parameters)
    kinds = [parameter.name for parameter in maps.parameters]
    for kind in kinds:
        (folder / kind).mkdir(exist_ok=True)
    for view in scene.train:
        found = render(view.camera, maps, MAP_SPP, mix(0, *view.name.encode())).numpy()
        for kind, values in parts_of(found, maps.parameters).items():
            write_exr(folder / kind / f"{view.name}.exr", values)
    for frame in described["frames"]:
        frame |= {f"{kind}_path": f"{kind}/{Path(frame['file_path']).name}" for kind in kinds}
    cameras.write_text(json.dumps(described, indent=1) + "\n")


if __name__ == "__main__":
    main()
