"""Draws ``docs/images/blender.jpg``: a room in Blender before and after ``neurad export --into``.

    python3.11 -m venv blender-python && blender-python/bin/pip install 'bpy==4.5.*'
    pip install -e '.[export]'
    python docs/before_after.py FOLDER --blender blender-python/bin/python

``benchmarks/rooms/blender_room_scene.py`` models a furnished room and has Cycles photograph it. A copy of its file, all
of whose paints are the same grey, is what somebody has who knows shapes and lamps alone. Its materials are found by the
photographs and put back into it. Cycles renders both files from a view that is held out, denoised. What FOLDER has
already is not made again.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

DOCS = Path(__file__).resolve().parent
ROOM = DOCS.parent / "benchmarks" / "rooms" / "blender_room_scene.py"
VIEWS = 24
"""Photographs; one more is held out."""
SIZE, SAMPLES = (800, 450), 64
"""Pixels of each picture, and samples of each."""
SEAM = 4
"""Pixels of white between the pictures."""
NAMES = ("as modelled: every paint grey", "after neurad export --into")
GREY = (0.5, 0.5, 0.5, 1.0)


def in_blender(job: dict[str, Any]) -> None:
    """For Blender's Python: open a file, make its paints grey or render a view of it, and write that."""
    import bpy

    bpy.ops.wm.open_mainfile(filepath=job["blend"], load_ui=False, use_scripts=False)
    if "grey" in job:
        for material in bpy.data.materials:
            make_grey(material.node_tree)
        bpy.ops.wm.save_as_mainfile(filepath=job["grey"])
        return
    scene = bpy.context.scene
    scene.camera = bpy.data.objects[job["view"]]
    scene.cycles.samples, scene.cycles.use_denoising, scene.cycles.denoiser = SAMPLES, True, "OPENIMAGEDENOISE"
    scene.render.threads_mode = "AUTO"
    scene.render.resolution_x, scene.render.resolution_y = SIZE
    scene.render.image_settings.file_format, scene.render.image_settings.color_mode = "OPEN_EXR", "RGB"
    scene.render.filepath = job["picture"]
    bpy.ops.render.render(write_still=True)


def make_grey(tree: Any) -> None:
    """Take the colours of a material away, unless it shines or is a mirror or glass."""
    shader = tree.nodes["Principled BSDF"]
    known = shader.inputs["Roughness"].default_value == 0.0 or shader.inputs["Emission Strength"].default_value > 0.0
    if known:
        return
    for link in shader.inputs["Base Color"].links:
        tree.links.remove(link)
    shader.inputs["Base Color"].default_value = GREY
    shader.inputs["Roughness"].default_value, shader.inputs["Metallic"].default_value = 0.5, 0.0


def main() -> None:
    """Make what is missing, then the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="for what is made on the way")
    parser.add_argument("--blender", required=True, help="a Python that has bpy")
    parser.add_argument("--view", default="train_015", help="from where it looks (default: %(default)s)")
    parser.add_argument("--time", default="00:00:05:00", help="of the fit (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=DOCS / "images" / "blender.jpg", help="file")
    options = parser.parse_args()
    folder: Path = options.folder.absolute()
    folder.mkdir(parents=True, exist_ok=True)
    python = str(Path(options.blender).absolute())
    photographs, root, bedroom = folder / "photographs", folder / "scene", folder / "bedroom.blend"
    neurad = [sys.executable, "-m", "neurad"]

    def made(path: Path, words: list[str]) -> Path:
        if not path.exists():
            subprocess.run(words, cwd=folder, check=True)
        return path

    def in_blender_made(path: Path, **job: str) -> Path:
        return made(path, [python, str(Path(__file__).resolve()), "--inside", json.dumps(job)])

    room = folder / "room.blend"
    views = ["--views", str(VIEWS), "1", "--samples", "64"]
    made(photographs / "test_000.exr", [python, str(ROOM), str(room), str(photographs), *views])
    in_blender_made(bedroom, blend=str(room), grey=str(bedroom))
    importing = ["data", "blender", str(bedroom), "--images", str(photographs), "--blender", python, "--out", str(root)]
    made(root, [*neurad, *importing])
    fitting = ["fit", "--config", "scene.yaml", "--data.root", str(root), "--trainer.max_time", options.time]
    made(folder / "lightning_logs", [*neurad, *fitting])
    recovered = made(
        folder / "bedroom_recovered.blend", [*neurad, "export", "--into", str(bedroom), "--blender", python]
    )
    pictures = [
        in_blender_made(path, blend=str(blend), view=options.view, picture=str(path))
        for blend, path in ((blend, blend.with_suffix(".exr")) for blend in (bedroom, recovered))
    ]
    draw(pictures, options.out)


def draw(pictures: list[Path], out: Path) -> None:
    """The pictures side by side at one exposure, with their names."""
    import numpy as np
    from picture import label, letters
    from PIL import Image, ImageDraw

    from neurad.images.image_io import read_exr
    from neurad.pages.colours import encode
    from neurad.scene.exposure import exposure

    radiance = [np.asarray(read_exr(file)[..., :3], np.float32) for file in pictures]
    factor = exposure(radiance[1:])
    page = Image.new("RGB", (len(pictures) * (SIZE[0] + SEAM) - SEAM, SIZE[1]), "white")
    pen, font = ImageDraw.Draw(page, "RGBA"), letters(24)
    for index, (picture, name) in enumerate(zip(radiance, NAMES, strict=True)):
        left = index * (SIZE[0] + SEAM)
        page.paste(Image.fromarray(encode(picture * factor)), (left, 0))
        label(pen, font, (left + font.size, SIZE[1] - 2.2 * font.size), name)
    page.save(out, quality=85, optimize=True)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--inside"]:
        in_blender(json.loads(sys.argv[2]))
    else:
        main()
