"""Draws ``docs/images/kitchen.png``, the picture of the README, from a finished run of the demo.

    neurad fit --config kitchen.yaml
    python docs/picture.py lightning_logs/version_0

It shows a held-out photograph, the albedo and the roughness that the run found, and the room with these in another
light: ``docs/evening.yaml``, traced by ``neurad render``. Run it in the folder of ``lightning_logs``, and name the run
that the fit printed.
"""

from __future__ import annotations

import argparse
import io
import json
import tempfile
from pathlib import Path

import matplotlib
import numpy as np
import numpy.typing as npt

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from PIL import Image

from neurad.cli import main as neurad
from neurad.formats.cameras.write import transforms
from neurad.formats.load import load_scene
from neurad.images.image_io import read_exr
from neurad.pages.colours import encode, grey
from neurad.scene.exposure import exposure

DOCS = Path(__file__).resolve().parent
EVENING = DOCS / "evening.yaml"
PANELS = ("photograph", "albedo, recovered", "roughness, recovered", "the same room, relit")
Bytes = npt.NDArray[np.uint8]


def panels(run: Path, scene: str, name: str, spp: int) -> list[Bytes]:
    """The four pictures of one held-out view, in the order of :data:`PANELS`.

    Args:
        run: run folder.
        scene: built-in scene that it is of.
        name: of the view.
        spp: samples a pixel of the relit room.
    """
    view = next(view for view in load_scene(None, scene).test if view.name == name)
    assert view.image is not None
    photograph = read_exr(view.image)[..., :3]
    with tempfile.TemporaryDirectory() as folder:
        camera, out = Path(folder) / "camera.json", Path(folder) / "relit"
        camera.write_text(json.dumps(transforms([view])))
        words = ["--camera", str(camera), "--edit", str(EVENING), "--integrator", "path", "--spp", str(spp)]
        neurad(["render", "--ckpt_path", str(run), *words, "--out", str(out)])
        relit, albedo, rough = (
            read_exr(next((out / kind).glob("*.exr"))) for kind in ("images", "albedo", "roughness")
        )
    day, evening = exposure([photograph]), exposure([relit[..., :3]])
    return [encode(photograph * day), encode(albedo[..., :3]), grey(rough[..., :1]), encode(relit[..., :3] * evening)]


def main(args: list[str] | None = None) -> None:
    """Compose the picture."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("run", type=Path, help="run folder")
    parser.add_argument("--scene", default="kitchen", help="built-in scene of the run (default: kitchen)")
    parser.add_argument("--view", default="test_000", help="held-out view to show (default: test_000)")
    parser.add_argument("--spp", type=int, default=256, help="samples a pixel of the relit room (default: 256)")
    parser.add_argument("--out", type=Path, default=DOCS / "images" / "kitchen.png", help="file")
    options = parser.parse_args(args)
    pictures = panels(options.run, options.scene, options.view, options.spp)
    figure, axes = plt.subplots(1, len(PANELS), figsize=(10.4, 2.85))
    for panel, picture, title in zip(axes, pictures, PANELS, strict=True):
        panel.imshow(picture, interpolation="nearest")
        panel.set_title(title, fontsize=10)
        panel.axis("off")
    figure.subplots_adjust(0.004, 0.01, 0.996, 0.91, 0.02, 0.02)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    with io.BytesIO() as drawn:
        figure.savefig(drawn, format="png", dpi=100)
        levels = np.asarray(Image.open(drawn).convert("RGB")) // 4 * 4 + 2  # a third smaller, and noise hides it
        Image.fromarray(levels.astype(np.uint8)).save(options.out, optimize=True)
    plt.close(figure)


if __name__ == "__main__":
    main()
