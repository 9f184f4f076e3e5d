"""Draws ``docs/images/kitchen.jpg``, the picture of the README, from a finished run of the demo.

    neurad fit --config kitchen.yaml
    python docs/picture.py lightning_logs/version_0

One wide view of the room in four parts: as photographs of it are made (with its true materials), the albedo and the
roughness that the run found, and the room with these in another light, ``docs/evening.yaml``. Lit parts are traced with
64 samples a pixel and denoised. Run it in the folder of ``lightning_logs``.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import uniform_filter

from neurad.cli import main as neurad
from neurad.core.parameters import ROUGHNESS
from neurad.core.scene_records import View
from neurad.formats.cameras.write import transforms
from neurad.formats.load import load_scene
from neurad.images.image_io import read_exr
from neurad.pages.colours import Bytes, encode, encode_parameter, ramp
from neurad.pages.sheet import scale_of
from neurad.scene.exposure import exposure

DOCS = Path(__file__).resolve().parent
EVENING = DOCS / "evening.yaml"
PARTS = ("photograph", "albedo, recovered", "roughness, recovered", "relit")
SIZE = (1600, 720)
FOCAL, RISE = 0.48, 0.1
"""Focal length over the width, and by how much of the height the picture looks up."""
SLANT, SEAM = 0.11, 2.0
"""How far a seam leans over the height, over the width, and half of its width in pixels."""
REACH, PATCH, AROUND = 8, 5, 15
"""Pixels that the denoiser looks away, those of a patch that it compares, and those with one variance of noise."""
STRENGTH, ALBEDO_VARIANCE = 1.5, 0.02
"""Differences of patches in variances of noise, and of albedo, at which weights fall to 1/e."""
DARKEST = 0.05
"""Albedo below which light is not divided by it."""


def camera_of(view: View, size: tuple[int, int], left: int, right: int) -> dict[str, Any]:
    """A camera file with the columns ``left`` to ``right`` of a wide picture from where a view stands."""
    width, height = size
    frame = transforms([view])["frames"][0]
    place = {"file_path": "part.exr", "transform_matrix": frame["transform_matrix"]}
    inside = {"w": right - left, "h": height, "fl_x": FOCAL * width, "fl_y": FOCAL * width}
    return {**inside, "cx": 0.5 * width - left, "cy": (0.5 + RISE) * height, "frames": [place]}


def rendered(words: list[str], seen: dict[str, Any], folder: Path, spp: int) -> dict[str, npt.NDArray[np.float32]]:
    """What ``neurad render`` makes of a camera file, or has made: picture, albedo and roughness [h, w, c]."""
    folder.mkdir(parents=True, exist_ok=True)
    camera, out = folder / "camera.json", folder / "out"
    camera.write_text(json.dumps(seen))
    if not any((out / "images").glob("*.exr")):
        settings = ["--integrator", "path", "--spp", str(spp), "--out", str(out), "--overwrite"]
        neurad(["render", *words, "--camera", str(camera), *settings])
    found = {kind: read_exr(next((out / kind).glob("*.exr"))) for kind in ("images", "albedo", "roughness")}
    return {kind: np.asarray(image[..., :3], np.float32) for kind, image in found.items()}


def clean(found: dict[str, npt.NDArray[np.float32]]) -> Bytes:
    """A lit picture as people look at it, without its noise: the light that arrives at surfaces, which is the picture
    over the albedo, is replaced by means over places whose surroundings look alike (non-local means).
    """
    albedo = np.maximum(found["albedo"], DARKEST)
    light = found["images"] / albedo
    unit = float(np.median(light))
    tone = np.sqrt(light / (light + unit))
    crossed = 0.5 * np.diff(np.diff(tone, axis=0), axis=1, append=0.0)
    variance = uniform_filter(np.square(np.pad(crossed, ((0, 1), (0, 0), (0, 0)))).mean(-1), AROUND) + 1e-9
    height, width = variance.shape
    wide, wide_albedo = (np.pad(x, ((REACH, REACH), (REACH, REACH), (0, 0)), "edge") for x in (tone, albedo))
    total, weights = np.zeros_like(tone), np.zeros_like(variance)
    for y, x in np.ndindex(2 * REACH + 1, 2 * REACH + 1):
        there = np.s_[y : y + height, x : x + width]
        apart = uniform_filter(np.square(tone - wide[there]).mean(-1), PATCH) / variance
        other = np.square(albedo - wide_albedo[there]).mean(-1) / ALBEDO_VARIANCE
        weight = np.exp(-np.maximum(apart - 2.0, 0.0) / STRENGTH - other)
        total += weight[..., None] * wide[there]
        weights += weight
    mean = np.minimum(np.square(total / weights[..., None]), 0.999)
    radiance = np.asarray(mean / (1.0 - mean) * unit * albedo, np.float32)
    return encode(radiance * exposure([radiance]))


def seams(size: tuple[int, int]) -> npt.NDArray[np.float64]:
    """Where each row of a picture has its parts' edges, the sides included [h, parts + 1]."""
    width, height = size
    lean = SLANT * width * (0.5 - (np.arange(height) + 0.5) / height)
    inner = width * np.arange(1, len(PARTS))[None] / len(PARTS) + lean[:, None]
    return np.concatenate([np.zeros((height, 1)), inner, np.full((height, 1), float(width))], 1)


def composed(pictures: list[Bytes], begins: list[int], size: tuple[int, int]) -> Image.Image:
    """The parts side by side, white lines between them, with their names.

    Args:
        pictures: of each part [h, w, 3].
        begins: column at which each one begins.
        size: width and height of the whole.
    """
    edges, x = seams(size), np.arange(size[0]) + 0.5
    whole = np.zeros((size[1], size[0], 3))
    for index, (picture, begin) in enumerate(zip(pictures, begins, strict=True)):
        placed = np.zeros_like(whole)
        placed[:, begin : begin + picture.shape[1]] = picture
        inside = (x >= edges[:, index, None]) & (x < edges[:, index + 1, None])
        whole[inside] = placed[inside]
    for edge in edges.T[1:-1]:
        cover = np.clip(SEAM + 0.5 - np.abs(x - edge[:, None]), 0.0, 1.0)[..., None]
        whole = cover * 255.0 + (1.0 - cover) * whole
    page = Image.fromarray(np.round(whole).astype(np.uint8))
    pen = ImageDraw.Draw(page, "RGBA")
    font = letters(size[0] // 64)
    y = size[1] - 2.2 * font.size
    for index, name in enumerate(PARTS):
        label(pen, font, (edges[round(y), index] + font.size, y), name)
    _bar(page, pen, font, round(edges[font.size, 2] + font.size))
    return page


def letters(size: int) -> ImageFont.FreeTypeFont:
    """The font of names, so many pixels high."""
    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts/ttf/DejaVuSans.ttf"), size)


def label(pen: ImageDraw.ImageDraw, font: ImageFont.FreeTypeFont, place: tuple[float, float], name: str) -> None:
    """A name in white on a dark plate."""
    box = pen.textbbox(place, name, font)
    pen.rounded_rectangle((box[0] - 8, box[1] - 6, box[2] + 8, box[3] + 6), 6, (0, 0, 0, 150))
    pen.text(place, name, "white", font)


def _bar(page: Image.Image, pen: ImageDraw.ImageDraw, font: ImageFont.FreeTypeFont, left: int) -> None:
    """The colour bar of roughness at the top of its part."""
    scale = scale_of(ROUGHNESS)
    assert scale is not None
    wide, high, top = 8 * font.size, font.size // 2, font.size
    pen.rounded_rectangle((left - 8, top - 8, left + wide + 8, top + high + 1.6 * font.size), 6, (0, 0, 0, 150))
    page.paste(Image.fromarray(ramp(scale.colours, wide)[None].repeat(high, 0)), (left, top))
    small = font.font_variant(size=round(0.8 * font.size))
    pen.text((left, top + high + 3), scale.low, "white", small)
    pen.text((left + wide - small.getlength(scale.high), top + high + 3), scale.high, "white", small)


def main(args: list[str] | None = None) -> None:
    """Compose the picture."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("run", type=Path, help="run folder")
    parser.add_argument("--scene", default="kitchen", help="built-in scene of the run (default: kitchen)")
    parser.add_argument(
        "--view", default="test_000", help="held-out view from whose place it looks (default: test_000)"
    )
    parser.add_argument("--spp", type=int, default=64, help="samples a pixel of the lit parts (default: 64)")
    parser.add_argument("--width", type=int, default=SIZE[0], help="in pixels (default: %(default)s)")
    parser.add_argument("--parts", type=Path, help="folder for what is rendered; what is there is not rendered again")
    parser.add_argument("--out", type=Path, default=DOCS / "images" / "kitchen.jpg", help="file")
    options = parser.parse_args(args)
    size = options.width, round(options.width * SIZE[1] / SIZE[0])
    view = next(view for view in load_scene(None, options.scene).test if view.name == options.view)
    edges = seams(size)
    begins = [int(edge.min()) for edge in edges.T[:-1]]
    ends = [min(int(edge.max()) + 2, size[0]) for edge in edges.T[1:]]
    run, truth = ["--ckpt_path", str(options.run)], ["--scene", options.scene]
    made = []
    lit = (truth, options.spp), (run, 1), (run, 1), ([*run, "--edit", str(EVENING)], options.spp)
    with tempfile.TemporaryDirectory() as folder:
        for part, begin, end, (words, spp) in zip(PARTS, begins, ends, lit, strict=True):
            kept = (options.parts or Path(folder)) / part
            made.append(rendered(words, camera_of(view, size, begin, end), kept, spp))
    pictures = [
        clean(made[0]), encode(made[1]["albedo"]),
        encode_parameter(ROUGHNESS, made[2]["roughness"][..., :1]), clean(made[3]),
    ]  # fmt: skip
    options.out.parent.mkdir(parents=True, exist_ok=True)
    composed(pictures, begins, size).save(options.out, quality=90, optimize=True)


if __name__ == "__main__":
    main()
