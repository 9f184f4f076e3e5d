"""Draws ``docs/kitchen.png``, the picture of the README, from a finished run of the demo.

    neurad fit --config kitchen.yaml
    neurad test
    python docs/picture.py lightning_logs/version_0

Run the first two in the folder that ``lightning_logs`` is to be in, and name the run that they print.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib
import numpy as np
import numpy.typing as npt

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from neurad.pages.colours import encode, exposure, grey
from neurad.scene.image_io import read_exr
from neurad.scene.load import load_scene

DOCS = Path(__file__).resolve().parent
VIEWS = (0, 1)
"""Held-out views shown, a row each."""
PAIRS = {"image": ("rendered", "photograph"), "albedo": ("found", "truth"), "roughness": ("found", "truth")}
Bytes = npt.NDArray[np.uint8]


def columns(run: Path, scene_name: str, index: int) -> list[Bytes]:
    """The pictures of one held-out view: what the run found and the truth, in the order of ``PAIRS``."""
    view = load_scene(None, scene_name).test[index]
    found = {kind: read_exr(run / "images" / f"{index:03d}_{kind}.exr") for kind in ("render", "albedo", "roughness")}
    assert view.image is not None
    assert view.albedo is not None
    assert view.roughness is not None
    photograph = read_exr(view.image)[..., :3]
    scale = exposure([{"photograph": photograph}])
    return [
        encode(found["render"] * scale), encode(photograph * scale),
        encode(found["albedo"]), encode(read_exr(view.albedo)[..., :3]),
        grey(found["roughness"][..., :1]), grey(read_exr(view.roughness)[..., :1]),
    ]  # fmt: skip


def main(args: list[str] | None = None) -> None:
    """Compose the picture."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("run", type=Path, help="run folder that `neurad test` wrote images/ into")
    parser.add_argument("--scene", default="kitchen", help="built-in scene of the run (default: kitchen)")
    parser.add_argument("--out", type=Path, default=DOCS / "kitchen.png", help="file (default: docs/kitchen.png)")
    options = parser.parse_args(args)
    table = [columns(options.run, options.scene, index) for index in VIEWS]
    figure, axes = plt.subplots(len(table), 6, figsize=(10.2, 1.68 * len(table) + 0.5), squeeze=False)
    for row, pictures in zip(axes, table, strict=True):
        for panel, picture in zip(row, pictures, strict=True):
            panel.imshow(picture, interpolation="nearest")
            panel.axis("off")
    for column, (kind, word) in enumerate((kind, word) for kind, pair in PAIRS.items() for word in pair):
        axes[0, column].set_title(f"{kind}, {word}", fontsize=10)
    figure.subplots_adjust(0.004, 0.004, 0.996, 1 - 0.35 / figure.get_figheight(), 0.02, 0.02)
    figure.savefig(options.out, dpi=100, metadata={"Software": None})
    plt.close(figure)


if __name__ == "__main__":
    main()
