"""Evaluations of large held-out views, in part."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.small_step import small_scene
from helpers.tiny_fit import fit, metrics, write_tiny_config

from neurad.assembly.build import build_world
from neurad.integrators.film import render, strided
from neurad.metrics import effort
from neurad.metrics.effort import Effort, affordable, seconds_of
from neurad.metrics.held_out import HeldOut
from neurad.scene.builtin import build
from neurad.scene.textures import TrueMaterials


def large(width=4000, height=3000, count=1):
    view = small_scene().test[0]
    return [replace(view, camera=replace(view.camera, width=width, height=height))] * count


def test_ordinary_views_are_scored_as_a_whole_and_large_ones_within_their_time():
    assert affordable(build("patterns").test, 16, 0.1, 30.0) == Effort()
    assert affordable(large(256, 256, 6), 64, 0.1, None) == Effort()
    for seconds, fraction in ((60.0, 0.1), (3600.0, 0.1), (None, 0.1)):
        found = affordable(large(), 4, fraction, seconds)
        assert found.grid == 2
        assert found.stride > 1
        assert seconds_of(large(), 4, found) <= max(30.0, 90.0 if seconds else 60.0)
    assert affordable(large(), 4, 0.5, 36000.0) == Effort()


def test_a_part_has_the_pixels_of_the_whole():
    scene = small_scene(size=7)
    world = build_world(scene)
    assert strided(7, torch.arange(9), 3).tolist() == [0, 3, 6, 21, 24, 27, 42, 45, 48]
    materials = TrueMaterials(scene, world.geometry)
    whole, part = (HeldOut(scene, world.geometry, world.tracer, 4, stride) for stride in (1, 3))
    full, few = (held_out.predict(materials)[0]["albedo"] for held_out in (whole, part))
    assert few.shape == (3, 3, 3)
    assert part.counted(0).shape == part.seen(0).shape == part.size(0) == (3, 3)
    same = np.abs(few - full[::3, ::3]).max(-1) < 1e-5  # but at edges, where positions differ
    assert same.mean() > 0.5
    depth = lambda rays, seed: world.intersect(rays).p  # noqa: E731
    points = [render(scene.test[0].camera, depth, 64, 1, stride=stride).numpy() for stride in (1, 3)]
    assert np.median(np.abs(points[0][::3, ::3] - points[1])) < 0.02


@pytest.mark.main
@pytest.mark.usefixtures("tiny")
def test_a_fit_says_that_it_scores_a_part(monkeypatch, capfd):
    write_tiny_config(evaluation={"every_n_steps": None, "spp": 1})
    monkeypatch.setattr(effort, "UNLIMITED", 0.01)
    fit("--trainer.max_steps=1")
    (line,) = [line for line in capfd.readouterr().err.splitlines() if "evaluation.fraction" in line]
    assert "one row and column in" in line
    assert "albedo_psnr_8x8" not in metrics()[0]
    assert float(metrics()[0]["albedo_psnr"]) > 5
