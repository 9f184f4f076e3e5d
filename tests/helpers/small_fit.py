"""A small Cornell box with photographs as a built-in scene, and short fits of it through the command line."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from helpers.object_scene import photographed
from helpers.small_step import GRID, small_scene
from helpers.tables import csv_rows
from neurad.cli import main
from neurad.core.scene_records import View

SMALL_FIT = {
    "seed_everything": 0,
    "trainer": {"accelerator": "cpu", "enable_progress_bar": False},
    "data": {"scene": "small", "patches": 256},
    "model": {part: {"grid": vars(GRID), "width": 32} for part in ("albedo", "roughness", "radiance")},
    "evaluation": {"every_n_steps": 1000, "spp": 2},
}


def photographed_cornell(folder, glossy, unit=1.0, more=()):
    """A Cornell box of 24 x 24 pixels with photographs and true albedo, written into ``folder``; ``more`` cameras are
    functions of the scene.
    """
    scene = small_scene(glossy=glossy, size=24)
    extra = [View(f"more_{index}", camera(scene)) for index, camera in enumerate(more)]
    scene = replace(scene, train=[*scene.train, *extra])
    lit = [m if m.radiance is None else replace(m, radiance=m.radiance * np.float32(unit)) for m in scene.meshes]
    scene = replace(scene, meshes=lit)
    return replace(photographed(scene, folder), name="small")


def fit_small(*args):
    """Rows of ``metrics.csv`` and the last checkpoint of a fit by ``fit.yaml`` and further arguments."""
    main(["fit", "--config", "fit.yaml", *args])
    folder = sorted(Path("lightning_logs").iterdir())[-1]
    rows = csv_rows(folder / "metrics.csv")
    return rows, torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)
