"""Lights without extent in the viewer: a slider each, and pictures of each alone that sum up to all of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.exported import assembled

from neurad.core.records import PunctualLight
from neurad.inspect.lamps import MAX_LAMPS, Lamp, lamp_renderer, lamps_of
from neurad.integrators.film import render
from neurad.integrators.renderer import path_tracer
from neurad.scene.builtin import build_cornell


def bulb(name, intensity, x=0.0):
    return PunctualLight(name, "point", np.full(3, intensity, np.float32), np.float32([x, 0.5, 0.2]))


def test_every_lamp_alone_sums_up_to_all():
    scene = replace(build_cornell(), punctual=(bulb("dim", 0.3, -0.5), bulb("bright", 3.0, 0.4)), max_depth=3)
    parts = assembled(scene)
    lamps = lamps_of(parts)
    assert {lamp.name for lamp in lamps} == {"light", "dim", "bright"}
    assert [lamp.name for lamp in lamps].index("bright") < [lamp.name for lamp in lamps].index("dim")
    camera = replace(scene.test[0].camera, width=8, height=8)
    alone = [render(camera, lamp_renderer(parts, lamp), 64, 3).mean() for lamp in lamps]
    whole = render(camera, path_tracer(parts.world, parts.materials, 3, 8), 128, 4).mean()
    assert float(sum(alone)) == pytest.approx(float(whole), rel=0.03)
    assert all(float(part) > 0.01 * float(whole) for part in alone)


def test_dim_ones_beyond_the_sliders_share_one():
    many = tuple(bulb(f"bulb {i}", 1.0 + i) for i in range(MAX_LAMPS + 3))
    lamps = lamps_of(assembled(replace(build_cornell(), punctual=many)))
    assert len(lamps) == MAX_LAMPS
    assert lamps[-1].name == "5 other lamps"
    assert sum(len(lamp.meshes) for lamp in lamps) == 1
    assert sorted(i for lamp in lamps for i in lamp.punctual) == list(range(MAX_LAMPS + 3))
    assert Lamp("environment").is_environment
    assert not any(lamp.is_environment for lamp in lamps)
