"""Paths between surfaces of several models, against Mitsuba's pictures of the same scene."""

from dataclasses import replace

import numpy as np
from helpers.pathtraced import picture

from neurad.core.camera import resized
from neurad.core.records import Constant, constant
from neurad.core.reflection import DiffuseModel, PrincipledModel, RoughConductorModel, RoughPlasticModel
from neurad.scene.builtin import build_cornell

SIZE, SAMPLES = 12, 512


def shiny_cornell():
    """The Cornell box with a model for each wall."""
    models = (
        DiffuseModel(),
        PrincipledModel(1.45),
        RoughConductorModel((0.2, 0.92, 1.1), (3.91, 2.45, 2.14), 0.2),
        RoughPlasticModel(1.5, 0.2),
        PrincipledModel(),
    )
    scene, roughness = build_cornell(), Constant(np.full(1, 0.4, np.float32))
    materials = [replace(m, model=models[i % len(models)], roughness=roughness) for i, m in enumerate(scene.materials)]
    bare = np.array(models[2].normal_reflectance, np.float32)  # as much as a metal can reflect
    materials = [replace(m, albedo=Constant(bare)) if m.model == models[2] else m for m in materials]
    materials = [replace(m, metallic=constant(0.8)) if m.model == models[1] else m for m in materials]
    return replace(scene, materials=materials, max_depth=5, rr_depth=100)


def test_a_room_of_many_models_looks_as_in_mitsuba(mi):
    from benchmarks.loaded import to_mitsuba

    scene = shiny_cornell()
    assert len(scene.features.models) > 2
    view = scene.train[0]
    ours = picture(scene, resized(view.camera, SIZE), SAMPLES, 1)
    theirs = np.array(mi.render(to_mitsuba(scene, view, SIZE, SAMPLES)))[..., :3]
    # means of blocks of 4 x 4 pixels, whose noise is about 1 %
    ours, theirs = (x.reshape(SIZE // 4, 4, SIZE // 4, 4, 3).mean((1, 3)) for x in (ours, theirs))
    assert np.abs(ours - theirs).max() < 0.1 * theirs.mean()
    np.testing.assert_allclose(ours.mean((0, 1)), theirs.mean((0, 1)), rtol=0.02)
