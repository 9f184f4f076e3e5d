"""What is wrong with all photographs is named, by measures with the right size, and nothing where nothing is."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.lamp_room import EVERYWHERE, Photographs, lamp_room, photographed

from neurad.assembly.build import build_world
from neurad.assembly.common_causes import _of_light, common_causes
from neurad.evidence.shading import Transport, transport
from neurad.evidence.shared_errors import shared_errors
from neurad.images.photographs import read_photograph
from neurad.scene import builtin
from neurad.scene.builtin.shapes import look_at

SEED = 3


@pytest.fixture(scope="module")
def kitchen():
    scene = builtin.build("kitchen")
    pictures = np.stack([read_photograph(view.image)[..., :3] for view in scene.train])
    return build_world(scene), [view.camera for view in scene.train], pictures


def source(pictures):
    views = len(pictures)

    class Source(Photographs):
        def ignored(self):
            return None

    return Source(torch.from_numpy(np.ascontiguousarray(pictures, np.float32)).reshape(views, -1, 3))


def corners(size):
    y, x = (np.mgrid[:size, :size] + 0.5) / size - 0.5
    return (x**2 + y**2) / 0.5


def bordered(pictures, value=0.02):
    made = np.full_like(pictures, value)
    made[:, 13:-13, 13:-13] = pictures[:, 13:-13, 13:-13]
    return made


def marked(pictures):
    """A logo that lets half of what is behind through."""
    made = pictures.copy()
    made[:, 200:230, 180:240] = 0.5 * made[:, 200:230, 180:240] + 0.5
    return made


def test_places_and_exposures_have_the_right_size(kitchen):
    world, cameras, pictures = kitchen
    bare = shared_errors(world, cameras, source(pictures))
    assert not bare.falloff.differs()
    assert bare.falloff.value == pytest.approx(0.0, abs=0.04)
    assert bare.spread.value < 0.05
    assert bare.border == {}
    assert bare.marked == 0.0
    log = np.random.default_rng(1).permutation(np.linspace(-0.5, 0.5, len(pictures)))
    falloff = np.exp(-0.5 * corners(256))[..., None]
    worse = shared_errors(world, cameras, source(pictures * np.exp(log)[:, None, None, None] * falloff))
    assert worse.falloff.value == pytest.approx(-0.5, abs=0.08)  # taken shortly before the corner
    assert worse.spread.value == pytest.approx(log.std(), abs=0.02)
    framed = shared_errors(world, cameras, source(bordered(pictures)))
    assert set(framed.border) == {"left", "right", "top", "bottom"}
    assert all(part == pytest.approx(13 / 256, abs=0.02) for part in framed.border.values())
    assert abs(framed.falloff.value) < 0.05
    # Of the brightness that the scene has: it does not differ from what other photographs show, but is the same in all.
    grey = shared_errors(world, cameras, source(bordered(pictures, np.median(pictures))))
    assert set(grey.border) == {"left", "right", "top", "bottom"}
    assert not grey.falloff.differs()
    logo = shared_errors(world, cameras, source(marked(pictures)))
    assert logo.border == {}
    assert logo.marked == pytest.approx(30 * 60 / 256**2, rel=0.3)


def test_the_other_side_of_a_sheet_is_another_surface():
    """A camera in a closed box photographs its dark inside: no other exposure of what others show of the outside."""
    inside = look_at((0.4, -0.8, -0.3), (0.4, -0.6, 0.0), 90.0, 28)
    scene = lamp_room(cameras=(*EVERYWHERE, inside))
    shown = photographed(scene, 64).pixels.reshape(-1, 28, 28, 3).numpy()
    assert shown[-1].max() == 0.0
    found = shared_errors(build_world(scene), [view.camera for view in scene.train], source(shown))
    assert found.spread.value == pytest.approx(0.0, abs=0.05)


def test_light_that_was_added_is_told_from_none(kitchen):
    world, cameras, pictures = kitchen
    bare = transport(world, cameras, source(pictures), SEED)
    assert bare.slope().value == pytest.approx(0.96, abs=0.08)
    assert bare.floor < 0.05
    assert bare.escaping < 0.01  # nothing but meshes all round; samples below their surface do not count
    mean = np.minimum(pictures, 10 * np.median(pictures)).mean()
    hazy = transport(world, cameras, source(pictures + 0.3 * mean), SEED)
    assert hazy.floor > 0.2
    assert hazy.slope().value < 0.8
    assert hazy.slope(offset=hazy.floor).value == pytest.approx(bare.slope().value, abs=0.08)


def test_dark_glossy_surfaces_are_no_response_curve():
    """They reflect the room whatever light arrives, as if it had been added to the photographs."""
    rng, meshes, each = np.random.default_rng(4), 60, 40
    mesh = np.repeat(np.arange(meshes), each)
    light = np.exp(rng.normal(size=len(mesh)) * 0.6)
    shown = rng.choice([0.02, 0.1, 0.6], meshes)[mesh] * light
    shown += 0.04 * shown.mean() / 0.96

    def seen(photographed):
        direct = np.tile(0.5 * light[:, None, None], (2, 2, 3))
        nowhere = np.full((2 * len(mesh), 2), -1)
        colors = np.repeat(photographed[:, None], 3, 1)
        return Transport(
            direct, np.zeros_like(direct), nowhere, np.tile(mesh, 2), np.arange(len(mesh)) % 20, colors, 0.0, 0.0, 0.04
        )  # fmt: skip

    assert seen(shown).slope().differs(1.0)
    assert seen(shown).slope(coat=0.04).value == pytest.approx(1.0, abs=0.01)
    assert _of_light(seen(shown), scale_known=True) == []
    assert "a response curve" in _of_light(seen(shown**0.6), scale_known=True)[0]


def test_a_border_is_said_before_another_field_of_view(kitchen, monkeypatch):
    """Its edges stand where a zoom would put those of the geometry."""
    from neurad.assembly import common_causes as module
    from neurad.evidence.edge_fit import SharedTurn

    world, cameras, pictures = kitchen
    monkeypatch.setattr(module, "shared_turn", lambda views: SharedTurn("zoom", 0.96))
    assert "field of view" in common_causes(world, cameras, source(pictures), SEED, views=[])[0]
    assert "a border" in common_causes(world, cameras, source(bordered(pictures)), SEED, views=[])[0]


def zoomed(cameras, factor):
    return [replace(c, fov_x=2 * math.atan(math.tan(c.fov_x / 2) * factor)) for c in cameras]


@pytest.mark.slow
def test_each_cause_is_named_and_no_other(kitchen):
    world, cameras, pictures = kitchen
    gains = np.exp(0.3 * np.random.default_rng(2).normal(size=(len(pictures), 1, 1, 1)))
    mean = np.minimum(pictures, 10 * np.median(pictures)).mean()
    right = {
        "": (cameras, pictures),
        "field of view": (zoomed(cameras, 1.05), pictures),
        "a border": (cameras, bordered(pictures)),
        "the same mark": (cameras, marked(pictures)),
        "vignetting": (cameras, pictures * ((1 + 0.5 * corners(256)) ** -2)[..., None]),
        "exposures differ": (cameras, pictures * gains),
        "haze": (cameras, pictures + 0.3 * mean),
        "a response curve": (cameras, pictures ** (1 / 2.2)),
    }
    for cause, (seen_by, shown) in right.items():
        said = common_causes(world, seen_by, source(shown), SEED)
        assert len(said) == bool(cause), (cause, said)
        assert cause in " ".join(said)


@pytest.mark.slow
def test_a_curve_is_told_from_lamps(kitchen):
    """Photographs to a power look as if the lamps were of another radiance, but surfaces do not follow these."""
    from neurad.emitters.area import AreaLights
    from neurad.emitters.lights import make_lights

    world, cameras, pictures = kitchen
    scene, power = builtin.build("kitchen"), 1.2

    def under(emission):
        return world.under(make_lights(scene, world.geometry, lamps=AreaLights(world.geometry, emission)))

    shining = world.geometry.emission
    bent = under(torch.where(shining > 0, shining**power, shining))
    known = {"scale_known": True, "power": power}
    (said,) = common_causes(bent, cameras, source(pictures**power), SEED, declared=world, **known)
    assert "gamma, about 1.20" in said
    known["power"] = 1.35
    assert common_causes(world, cameras, source(pictures), SEED, declared=under(shining / 2.0), **known) == []
