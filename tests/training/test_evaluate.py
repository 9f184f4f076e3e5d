"""Pictures of an evaluation: what few samples show with the radiance field as control variate."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.lamp_scene import with_lamps
from helpers.tables import csv_rows
from helpers.tiny_fit import fit, run_folder

from neurad.assembly.build import build_world
from neurad.cli import main
from neurad.core.rng import Stream
from neurad.integrators.estimator import Estimator
from neurad.integrators.film import box_mean, render
from neurad.integrators.method import SceneModel
from neurad.integrators.radiometric import Radiometric
from neurad.integrators.renderer import FieldRenderer
from neurad.metrics.held_out import HeldOut
from neurad.scene.builtin import build_cornell
from neurad.scene.builtin.plain import views
from neurad.scene.textures import TrueMaterials
from neurad.training.evaluate import STEADY, evaluate, steadied


def test_box_means_are_those_of_the_pixels_that_there_are():
    image = torch.arange(20.0).view(4, 5, 1)
    found = box_mean(image, 3)
    assert float(found[1, 1]) == pytest.approx(float(image[:3, :3].mean()))
    assert float(found[0, 4]) == pytest.approx(float(image[:2, 3:].mean()))


def test_a_steadied_picture_keeps_the_mean_and_loses_the_noise():
    """The right side is the left one and a smooth difference, with noise of standard deviation 0.5."""
    stream = Stream(3)
    left = stream.uniform(64, 64, 3)  # as detailed as can be
    slope = torch.linspace(0, 0.2, 64).view(1, 64, 1).expand(64, 64, 3)
    noise = 0.5 * torch.randn(64, 64, 3, generator=stream.generator)
    found = steadied(left + slope + noise, left)
    inside = slice(STEADY, -STEADY)
    error = (found - left - slope)[inside, inside]
    assert float(error.std()) == pytest.approx(0.5 / STEADY, rel=0.15)
    # 46 x 46 x 3 pixels: the mean of the noise has a standard deviation of 0.5 / 80
    assert abs(float(error.mean())) < 4 * 0.5 / 80


def test_emitters_have_the_mean_of_all_positions():
    """A lamp covers pixels in part: what the held-out views' positions see of it is what a rendering converges to."""
    scene = build_cornell()
    scene = replace(scene, test=views("up", [((0.0, 0.0, 0.0), (0.05, 1.0, 0.1))], 70.0, 32))
    world = build_world(scene)
    materials = TrueMaterials(scene, world.geometry)
    held_out = HeldOut(scene, world.geometry, world.tracer)
    parts = SceneModel(world, materials, lambda si, albedo: torch.full_like(si.p, 0.25))
    found = held_out.emitted(0, world.emitted)
    assert float(found.max()) > 1.0
    whole, emitted = render(scene.test[0].camera, FieldRenderer(parts, parts=True), 64, 1).tensor_split((3,), -1)
    torch.testing.assert_close(whole - emitted, torch.full_like(whole, 0.25), atol=1e-4, rtol=0)
    assert float((found - emitted).abs().mean()) < 0.02 * float(emitted.mean())


def test_pictures_of_recovered_lamps_are_those_of_known_ones():
    """By few samples the edges of lamps would decide; whatever the lamps' radiance is by now."""
    scene = build_cornell()
    scene = replace(scene, test=views("up", [((0.0, 0.0, 0.0), (0.05, 1.0, 0.1))], 70.0, 32))
    world, lamps = with_lamps(scene)
    materials = TrueMaterials(scene, world.geometry)

    def shown(world, held_out):
        estimator = Estimator(world, materials, lambda si, albedo: torch.full_like(si.p, 0.25), Radiometric())
        return evaluate(held_out, estimator, 1, steady=True).maps[0]["render"]

    held_out = HeldOut(scene, world.geometry, world.tracer)
    known = build_world(scene)
    wanted = shown(known, HeldOut(scene, known.geometry, known.tracer))
    np.testing.assert_allclose(shown(world, held_out), wanted, atol=0.02 * float(wanted.max()))
    lit = wanted > 2.0
    lamps.set_radiance(2.0 * lamps.found())
    assert np.median(shown(world, held_out)[lit] / wanted[lit]) == pytest.approx(2.0, rel=0.05)


def test_a_fit_logs_the_fields_picture_and_a_steady_one(tiny, capfd):
    """Four samples with the control variate are nearer to 64 samples' score than four without. After so few steps a
    field is a good control variate only if what channels share counts in full.
    """
    fit("--trainer.max_steps", "120", "--evaluation.spp", "4", "--model.objective.chroma_weight", "1")
    row = csv_rows(run_folder() / "metrics.csv")[-1]
    shown = capfd.readouterr().out
    assert "the radiance field as control variate" in shown

    def tested(spp):
        main(["test", "--config", "tiny.yaml", "--ckpt_path", "last", "--evaluation.test_spp", str(spp)])
        newest = max(Path("lightning_logs").glob("*/metrics.json"), key=lambda path: path.stat().st_mtime)
        return json.loads(newest.read_text())

    few, many = tested(4), tested(64)
    assert float(row["psnr_lhs"]) == pytest.approx(many["psnr_lhs"], abs=0.3)
    assert abs(float(row["psnr_linear"]) - many["psnr_linear"]) < 0.5 * abs(few["psnr_linear"] - many["psnr_linear"])
