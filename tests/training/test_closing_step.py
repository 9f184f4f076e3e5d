"""A step from all training pixels at once: what is off comes right, and what halves of them do not confirm stays."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.torch_threads import torch_threads

from benchmarks.stress.fit import Fit, Plan, photographs, small_settings
from benchmarks.stress.scenes import small_cube, with_material
from neurad.core import parameters
from neurad.core.reflection import PrincipledModel
from neurad.evidence.closing_calibration import robust_weight
from neurad.evidence.roughness_evidence import Evidence
from neurad.fields.material import CORRECTION_CELLS, Correction
from neurad.fields.settings import RoughnessConfig
from neurad.training import closing_step
from neurad.training.closing_step import Agreement, agreement, make_closing_step, progress_before, should_close
from neurad.training.schedule import Progress

ROUGHNESS, STEPS = 0.3, 100


@pytest.fixture(scope="module")
def room():
    """A short fit of a glossy room."""
    scene = with_material(small_cube(24), PrincipledModel(), 0.4, ROUGHNESS)
    return Fit(scene, photographs(scene, 128), Plan(steps=STEPS)).run()


def step_of(room, counters=None):
    training = room.training
    return make_closing_step(training.assembly, training.views, room.photos, counters or training.step.counters)


def forget(correction):
    correction.load_state_dict(Correction().state_dict())


def mean_roughness(room):
    return float(room.surface(room.seen(2048)).roughness.mean())


def test_a_run_without_a_trainer_has_made_its_step(room):
    assert room.training.iteration == STEPS
    assert room.training.assembly.correction.done


@pytest.mark.parametrize("off", [0.12, -0.1])
def test_what_is_off_comes_right(room, off):
    """Roughness that is off everywhere, with all else as the fit found it: two steps from few pixels, against a prior
    that expects details and no shift of everything, take back a seventh of it at least.
    """
    before = mean_roughness(room)
    correction = room.training.assembly.correction
    try:
        correction.add(np.full((CORRECTION_CELLS + 1,) * 3, off, np.float32))
        assert mean_roughness(room) == pytest.approx(before + off, abs=0.01)
        counters = replace(room.training.step.counters, samples=1 << 20)
        for least in (0.5, 0.0):  # less is left for the second
            found = step_of(room, counters)
            assert found.kept > least, found
            assert "corrected by" in found.sentence()
            assert float(correction.information.sum()) > 0.0
            assert (correction.scales > 0.0).all()
            correction.reopen()
        assert counters.samples > 1 << 20
        left = (mean_roughness(room) - before) / off
        assert 0.0 < left < 6 / 7
    finally:
        forget(correction)


@pytest.mark.parametrize("threads", [1, 3])
def test_the_same_step_at_every_call_by_any_number_of_threads(room, threads):
    correction = room.training.assembly.correction
    counters, tracer = room.training.step.counters, room.training.assembly.world.tracer
    try:
        step_of(room, replace(counters))
        first = {name: value.clone() for name, value in correction.state_dict().items()}
        forget(correction)
        cast = tracer.rays_cast
        with torch_threads(threads):
            step_of(room, replace(counters))
        assert all(torch.equal(value, first[name]) for name, value in correction.state_dict().items())
        once = tracer.rays_cast - cast
        forget(correction)
        step_of(room, replace(counters))
        assert tracer.rays_cast - cast == 2 * once > 0
    finally:
        forget(correction)


@pytest.mark.parametrize("seconds", [1e-6, 1e6])
def test_the_pass_fits_into_what_is_left_of_the_time(room, seconds):
    """Next to no time leaves the fewest pixels, and so a step without much in it; more than enough changes nothing."""
    correction = room.training.assembly.correction
    try:
        counters = [replace(room.training.step.counters) for _ in range(2)]
        step_of(room, counters[0])
        forget(correction)
        training = room.training
        make_closing_step(training.assembly, training.views, room.photos, counters[1], seconds=seconds)
        used = [count.samples - training.step.counters.samples for count in counters]
        if seconds > 1:
            assert used[1] == used[0]
        else:
            assert used[1] < 0.5 * used[0]
    finally:
        forget(correction)


def test_when_it_is_due():
    correction = Correction()
    assert not should_close(None, 0.9)
    assert not should_close(correction, 0.99)
    assert should_close(correction, 1.0)
    correction.add(None)
    assert not should_close(correction, 1.0)  # made, whatever it found
    assert not should_close(correction, 0.4)  # a fit that goes on for longer ...
    assert should_close(correction, 1.0)  # ... makes another one


def test_time_and_steps_lead_to_it():
    """Its samples take time and no steps, so time is left for them."""
    half, whole = RoughnessConfig(closing_samples=0.4), RoughnessConfig(closing_samples=0.8)
    assert progress_before(Progress(None, 0.45, 1.0), half) == pytest.approx(0.5)
    assert progress_before(Progress(None, 0.4, 1.0), whole) == pytest.approx(0.5)
    assert progress_before(Progress(0.5 * closing_step.STEPS, None, 1.0), half) == pytest.approx(0.5)
    assert progress_before(Progress(0.1, 0.8, 1.0), whole) == pytest.approx(1.0)
    assert progress_before(Progress(closing_step.STEPS, 0.1, 1.0), whole) == pytest.approx(1.0)
    assert closing_step.STEPS < 1.0


def test_a_second_step_goes_on_from_the_first():
    correction, change = Correction(), np.full((CORRECTION_CELLS + 1,) * 3, 0.1, np.float32)
    correction.add(change)
    correction.reopen()
    assert correction.found
    correction.add(change)
    torch.testing.assert_close(correction(torch.full((1, 3), 0.3)), torch.tensor([[0.2]]))


def test_only_what_halves_confirm_is_kept():
    rng = np.random.default_rng(0)
    x = rng.random((400, 3)) * [0.2, 0.2, 0.01] + 0.4
    information = np.full(400, 200.0)

    def half(change):
        return Evidence(128, x, information, information * (change + rng.normal(0.0, 1.0 / np.sqrt(information))))

    bump = 0.1 * np.sin(30.0 * x[:, 0])
    agreed = agreement(half(bump), half(bump), CORRECTION_CELLS)
    assert agreed.kept > 0.6
    # The most that there is to explain, and what a step from one half of it can.
    most = 2.0 * float((robust_weight(information) * information * np.square(bump)).sum())
    assert 0.4 * most < agreed.explained < 1.1 * most
    noise = [agreement(half(0.0), half(0.0), CORRECTION_CELLS) for _ in range(20)]
    assert np.mean([each.kept for each in noise]) < 0.25
    assert np.mean([each.explained for each in noise]) < 0.05 * most
    assert agreement(half(bump), half(-bump), CORRECTION_CELLS) == Agreement(0.0, 0.0)


def test_a_correction_in_the_state(room):
    """It travels with a checkpoint, is no optimizer's, and never leaves the range of roughness."""
    values = np.zeros((CORRECTION_CELLS + 1,) * 3, np.float32)
    values[3, 5, 7] = 0.25
    correction = Correction()
    correction.add(values, np.full((CORRECTION_CELLS,) * 3, 9.0, np.float32))
    at = torch.tensor([[3.0, 5.0, 7.0], [3.5, 5.0, 7.0], [20.0, 5.0, 7.0]]) / CORRECTION_CELLS
    torch.testing.assert_close(correction(at)[:, 0], torch.tensor([0.25, 0.125, 0.0]), atol=1e-5, rtol=0)
    other = Correction()
    other.load_state_dict(correction.state_dict())
    assert other.done
    assert other.found
    torch.testing.assert_close(other(at), correction(at))
    assert bool((other.information == 9.0).all())
    assert not any(p.requires_grad for p in correction.parameters())
    field, own = room.materials.recovered["roughness"], room.training.assembly.correction
    held = {id(p) for group in room.training.optimizers["roughness"].param_groups for p in group["params"]}
    assert not held & {id(p) for p in own.parameters()}
    try:
        own.add(np.full((CORRECTION_CELLS + 1,) * 3, -2.0, np.float32))
        si = room.seen(64)
        assert float(field(si, torch.full((len(si), 3), 0.5)).min()) == pytest.approx(parameters.ROUGHNESS.low)
    finally:
        forget(own)


def test_nothing_is_built_where_it_is_not_wanted():
    settings = small_settings()
    assert settings.roughness.closing_step
    scene = small_cube(16)
    images = torch.full((len(scene.train), 256, 3), 0.5)
    diffuse = Fit(scene, images, Plan(settings=settings))
    assert diffuse.training.assembly.correction is None
    glossy = with_material(scene, PrincipledModel(), 0.4, 0.3)
    without = replace(settings, roughness=replace(settings.roughness, closing_step=False))
    assert Fit(glossy, images, Plan(settings=without)).training.assembly.correction is None
