"""Photographs tell which diffuse lobe surfaces have, wherever the search begins, and a checkpoint keeps the answer."""

from dataclasses import replace

import pytest
import torch

from benchmarks.stress.fit import Fit, Plan, photographs, small_cube, small_settings, with_material
from neurad.core.reflection import PrincipledModel
from neurad.training import stages
from neurad.training.diffuse_lobe import decide, keep_in_range, look_again

LOBES = {"burley": 0.0, "lambert": 1.0}


def glossy(lobe):
    return with_material(small_cube(24), PrincipledModel(diffuse=lobe), 0.7, 0.2)


def fit_of(begin, images=None, **settings):
    images = photographs(glossy(begin), 1) if images is None else images
    return Fit(glossy(begin), images, Plan(steps=1, settings=replace(small_settings(), **settings)))


@pytest.mark.parametrize("begin", LOBES)
@pytest.mark.parametrize("moved", [0.3, 0.6, 0.9])
def test_the_lobe_of_which_there_is_more_is_taken_and_kept(begin, moved):
    part = abs(LOBES[begin] - moved)
    found = begin if moved < 0.5 else next(lobe for lobe in LOBES if lobe != begin)
    fit = fit_of(begin)
    assembly, si = fit.training.assembly, fit.seen(8)
    assert float(assembly.world.lambert) == float(assembly.materials.lambert.detach()) == LOBES[begin]
    assert torch.equal(assembly.materials(si).lambert, torch.full((len(si), 1), LOBES[begin]))
    with torch.no_grad():
        assembly.materials.lambert.fill_(2.0)
        keep_in_range(assembly.materials)
        assert float(assembly.materials.lambert) == 1.0
        assembly.materials.lambert.fill_(part)
    assert (decide(assembly) is None) == (found == begin)
    assert assembly.fitted_model == PrincipledModel(diffuse=found)
    again = fit_of(begin).training.assembly
    for name, module in again.modules():
        module.load_state_dict(dict(assembly.modules())[name].state_dict())
    assert again.fitted_model == assembly.fitted_model
    assert getattr(again.world.bsdf, "fitted", again.world.bsdf).lambert == LOBES[found]
    assert again.materials(si).lambert is None


@pytest.mark.parametrize("lobe", LOBES)
def test_a_lobe_that_is_told_is_not_looked_for(lobe):
    assembly = fit_of("burley", diffuse_lobe=lobe).training.assembly
    assert assembly.materials.lambert is None
    assert assembly.fitted_model == PrincipledModel(diffuse=lobe)


@pytest.mark.slow
@pytest.mark.parametrize("begin", LOBES)
def test_photographs_of_the_other_lobe_lead_to_it(begin, monkeypatch):
    monkeypatch.setattr(stages, "DECIDED", 2.0)
    settings = small_settings()
    faster = replace(settings.optimization, roughness=3e-2)
    plan = Plan(steps=320, pixels=256, settings=replace(settings, optimization=faster))
    moved = {}
    for true in LOBES:
        fit = Fit(glossy(begin), photographs(glossy(true), 256), plan).run()
        moved[true] = abs(float(fit.training.assembly.materials.lambert.detach()) - LOBES[begin])
    own = moved.pop(begin)
    assert min(moved.values()) > own + 0.1


def test_the_search_begins_anew_where_metals_were_found():
    assembly = fit_of("burley").training.assembly
    with torch.no_grad():
        assembly.materials.lambert.fill_(0.9)
    decide(assembly)
    look_again(assembly)
    assert assembly.materials.looks_for_lobe
    assert float(assembly.world.lambert) == float(assembly.materials.lambert.detach()) == 0.0
