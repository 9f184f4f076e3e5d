"""Training views that do not fit the others: found, named once, and no false alarm."""

import csv
import random

import numpy as np
import pytest
import torch
from helpers.tiny_fit import fails, fit, run_folder
from helpers.tiny_scene import POSE, read_json, write_json, write_scene

from neurad.callbacks.training_views import ViewTable
from neurad.core.records import PixelBatch
from neurad.evidence.view_residuals import few, outliers, per_view

AWAY = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 500.0], [0.0, 0.0, 1.0, 4.0], [0.0, 0.0, 0.0, 1.0]]


def test_only_views_far_outside_are_found():
    chosen = random.Random(3)
    for count in (4, 8, 50, 200):
        residuals = [0.05 * chosen.uniform(0.8, 1.25) for _ in range(count)]
        assert outliers(residuals) == []
        residuals[2], residuals[0] = 0.2, 0.3
        assert outliers(residuals) == ([0, 2] if count > 4 else [])
    assert outliers([0.05, 0.05, 0.9]) == []  # too few to say which are the others
    assert outliers([0.05] * 6 + [float("nan"), 0.12]) == [7]


def test_means_are_those_of_each_view():
    view = torch.tensor([2, 0, 2, 0, 2])
    sample = PixelBatch(view, torch.arange(5), torch.rand(5, 3), torch.ones(5), 0)
    assert sorted(few(sample, 3).pixel.tolist()) == [0, 1, 2, 3, 4]
    means = per_view(torch.tensor([1.0, 2.0, 3.0, 4.0, 5.0]), view, 3)
    assert means[0] == 3.0
    assert np.isnan(means[1])
    assert means[2] == 3.0


def test_a_view_is_named_once(capsys, tmp_path):
    table = ViewTable([f"v{i}" for i in range(5)], np.ones(5))
    table.update(tmp_path, 10, np.array([0.2, 0.2, 0.2, 0.2, 0.6]))  # little is learnt: it may be chance
    assert capsys.readouterr().err == ""
    table.update(tmp_path, 20, np.array([0.02, 0.02, 0.02, 0.02, 0.5]))
    error = capsys.readouterr().err
    assert "training view v4 (0.50) differs from the photographs far more than the others (median 0.02)" in error
    table.update(tmp_path, 30, np.array([0.02, 0.02, 0.02, 0.02, 0.5]))
    assert capsys.readouterr().err == ""
    with (tmp_path / "views.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert rows[4] == {"view": "v4", "surface": "1", "residual": "0.5", "iteration": "30"}


@pytest.mark.main
def test_cameras_that_see_nothing(tiny, capfd):
    pytest.importorskip("mitsuba")
    room = write_scene(tiny / "room")
    cameras = read_json(room, "train")
    frames = cameras["frames"]
    arguments = ("--data.scene=null", "--data.root=room", "--trainer.max_steps=2", "--evaluation.every_n_steps=2")
    frames[1]["transform_matrix"] = AWAY
    write_json(room, "train", cameras)
    fit(*arguments)
    error = capfd.readouterr().err
    assert "of the pixels of training view train_1 (0 %) few meet a surface" in error
    with (run_folder() / "views.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [float(row["surface"]) > 0 for row in rows] == [True, False, True]
    assert all(0 <= float(row["residual"]) <= 1 for row in rows)

    for frame in frames:
        frame["transform_matrix"] = AWAY
    write_json(room, "train", cameras)
    assert "no training camera sees a surface" in fails(capfd, "fit", "--config", "tiny.yaml", *arguments)
    assert POSE != AWAY
