"""What all training pixels say of the roughness: what is off comes right, it is the same at every call, and it ends."""

from dataclasses import replace

import pytest
import torch
from helpers.torch_threads import torch_threads

from benchmarks.photos import PhotosInMemory
from benchmarks.stress.fit import Fit, Plan, photographs, small_cube, small_settings, with_material
from neurad.core.reflection import PrincipledModel
from neurad.fields.hierarchy import Hierarchy
from neurad.integrators.direct import Direct
from neurad.integrators.prb import PRB
from neurad.training import roughness_refinement
from neurad.training.roughness_refinement import progress_before, refine_roughness, should_refine
from neurad.training.schedule import Progress
from neurad.training.session import TrainingRun

ROUGHNESS, STEPS = 0.3, 200


@pytest.fixture(scope="module")
def room():
    """A short fit of a glossy room."""
    scene = with_material(small_cube(24), PrincipledModel(), 0.4, ROUGHNESS)
    return Fit(scene, photographs(scene, 128), Plan(steps=STEPS)).run()


@pytest.fixture
def hierarchy(room):
    """What the fit has found, put back afterwards."""
    found = room.training.assembly.hierarchy
    before = {name: value.clone() for name, value in found.state_dict().items()}
    yield found
    found.load_state_dict(before)


@pytest.mark.parametrize("method", [PRB(3), Direct()])
def test_a_method_without_a_field_has_the_same_stages(method):
    """Roughness by all pixels, the lobe and metals are found by what the method itself estimates."""
    scene = with_material(small_cube(16), PrincipledModel(), 0.4, ROUGHNESS)
    settings = small_settings()
    looks = replace(settings.roughness, begin="best"), replace(settings.metallic, recover="fit")
    settings = replace(settings, method=method, roughness=looks[0], metallic=looks[1])
    photos = PhotosInMemory(photographs(scene, 16), 16, 256, 0)
    run = TrainingRun.of_scene(scene, photos, settings)
    for i in range(60):
        run.advance(i / 60)
    assembly = run.assembly
    assert assembly.radiance is None
    assert assembly.hierarchy.done
    assert assembly.hierarchy.found
    assert assembly.metalness.done
    assert not assembly.materials.looks_for_lobe


def step_of(room, counters=None, seconds=None):
    training = room.training
    counters = counters or training.step.counters
    return refine_roughness(training.assembly, training.views, room.photos, counters, seconds=seconds)


def values(room):
    return room.surface(room.seen(2048)).roughness


def test_a_run_without_a_trainer_has_made_its_step(room):
    assert room.training.iteration == STEPS
    assert room.training.assembly.hierarchy.done


def test_one_roughness_comes_out_as_one(room, hierarchy):
    """With as many samples as a fit of minutes has, walls of one roughness are flat, and near it."""
    hierarchy.set(None)
    before = values(room)
    counters = replace(room.training.step.counters, samples=1 << 20)
    change = step_of(room, counters)
    after, std = values(room), room.materials.std(room.seen(2048).p)["roughness"]
    assert change is not None
    assert change > 0.0
    assert counters.samples > 1 << 20
    assert (after.mean() - ROUGHNESS).abs() < 0.5 * (before.mean() - ROUGHNESS).abs() + 0.02
    assert float(after.std()) < 0.02
    assert bool((std > 0.0).all())
    assert not after.requires_grad


@pytest.mark.parametrize("threads", [1, 3])
def test_the_same_step_at_every_call_by_any_number_of_threads(room, hierarchy, threads):
    step_of(room, replace(room.training.step.counters))
    first = {name: value.clone() for name, value in hierarchy.state_dict().items()}
    with torch_threads(threads):
        step_of(room, replace(room.training.step.counters))
    assert all(torch.equal(value, first[name]) for name, value in hierarchy.state_dict().items())


@pytest.mark.parametrize("seconds", [1e-6, 1e6])
def test_the_pass_fits_into_what_is_left_of_the_time(room, hierarchy, seconds):
    """Next to no time leaves the fewest pixels; more than enough changes nothing."""
    counters = [replace(room.training.step.counters) for _ in range(2)]
    step_of(room, counters[0])
    step_of(room, counters[1], seconds)
    used = [count.samples - room.training.step.counters.samples for count in counters]
    assert used[1] == used[0] if seconds > 1 else used[1] < 0.5 * used[0]


def test_when_it_is_due_by_time_and_steps():
    hierarchy = Hierarchy("auto", 8)
    assert not should_refine(None, 0.9)
    assert not should_refine(hierarchy, 0.99)
    assert should_refine(hierarchy, 1.0)
    hierarchy.set(None)
    assert not should_refine(hierarchy, 1.0)  # made, whatever it found
    assert not should_refine(hierarchy, 0.4)  # a fit that goes on for longer ...
    assert should_refine(hierarchy, 1.0)  # ... makes another one

    # Its samples take time and no steps, so time is left for them.
    time = 1.0 - roughness_refinement.RESERVED_TIME
    assert progress_before(Progress(None, 0.5 * time, 1.0)) == pytest.approx(0.5)
    assert progress_before(Progress(0.5 * roughness_refinement.STEPS, None, 1.0)) == pytest.approx(0.5)
    assert progress_before(Progress(0.1, time, 1.0)) == pytest.approx(1.0)
    assert progress_before(Progress(roughness_refinement.STEPS, 0.1, 1.0)) == pytest.approx(1.0)
    assert roughness_refinement.STEPS < 1.0


def test_a_position_reads_what_the_surface_there_has(room, hierarchy):
    """Positions alone find their connected part."""
    step_of(room, replace(room.training.step.counters, samples=1 << 20))
    si = room.seen(512)
    at = room.materials.at(si.p)["roughness"]
    torch.testing.assert_close(at, room.materials.at(si.p, si.prim)["roughness"])


def test_nothing_is_built_where_it_is_not_wanted():
    settings = small_settings()
    assert settings.roughness.structure == "auto"
    scene = small_cube(16)
    images = torch.full((len(scene.train), 256, 3), 0.5)
    diffuse = Fit(scene, images, Plan(settings=settings))
    assert diffuse.training.assembly.hierarchy is None
    glossy = with_material(scene, PrincipledModel(), 0.4, 0.3)
    without = replace(settings, roughness=replace(settings.roughness, structure="free"))
    assert Fit(glossy, images, Plan(settings=without)).training.assembly.hierarchy is None
