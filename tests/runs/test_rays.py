"""The column ``rays``: those that training cast, in ``metrics.csv``, in checkpoints and in ``metrics.json``."""

import csv
import json
from pathlib import Path

import torch
from helpers import tiny_fit

from neurad.cli import main


def fit(*words):
    tiny_fit.fit("--data.patches=64", *words)
    folder = max(Path("lightning_logs").iterdir(), key=lambda path: path.stat().st_mtime)
    with (folder / "metrics.csv").open() as file:
        return folder, [int(row["rays"]) for row in csv.DictReader(file)]


def test_only_training_counts(tiny):
    """However often a run is evaluated, stopped, continued and tested."""
    folder, once = fit("--trainer.max_steps=6", "--evaluation.every_n_steps=100", "--trainer.default_root_dir=.")
    _, often = fit("--trainer.max_steps=6", "--evaluation.every_n_steps=2")
    assert len(once) == 1
    assert len(often) == 3
    assert once[-1] == often[-1]
    assert often[0] < often[1] < often[2]
    per_step = (often[2] - often[1]) / 2
    assert often[0] > 2 * per_step, "the camera rays of the set-up count"
    main(["fit", "--ckpt_path", str(folder / "checkpoints/last.ckpt"), "--trainer.max_steps=8"])
    state = torch.load(folder / "checkpoints/last.ckpt", weights_only=True)["neurad"]
    assert abs(state["rays"] - once[-1] - 2 * per_step) < 0.05 * per_step, "a continued run counts its steps alone"
    main(["test", "--ckpt_path", str(folder / "checkpoints/last.ckpt")])
    assert json.loads((folder / "metrics.json").read_text())["rays"] == state["rays"]
