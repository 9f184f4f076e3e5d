"""Edits of lights without extent, and what a checkpoint keeps of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from neurad.core.errors import InputError
from neurad.core.records import PunctualLight
from neurad.formats.edits.edit import edited, lamps_of
from neurad.formats.edits.edit_file import edit_of
from neurad.scene.builtin import build_cornell
from neurad.scene.light import light_changes, light_of


@pytest.fixture(scope="module")
def scene():
    """The Cornell box with a bulb and a sun beside its lamp."""
    one = np.ones(3, np.float32)
    bulb = PunctualLight("bulb", "point", 2 * one, np.float32([0, 0.5, 0]))
    sun = PunctualLight("sun", "directional", one, direction=np.float32([0, -1, 0]))
    return replace(build_cornell(), punctual=(bulb, sun))


def changed(scene, **lamps):
    return edited(scene, edit_of({"lamps": lamps}))


def test_they_are_lamps_with_names(scene):
    assert lamps_of(scene) == ["light", "bulb", "sun"]


def test_scaled_coloured_moved_and_off(scene):
    made = changed(scene, bulb={"scale": 0.5, "color": [1, 0, 0], "move": [0, 0.25, 0]}, sun=False)
    bulb, sun = made.scene.punctual
    np.testing.assert_allclose(bulb.intensity, [1 / 0.212671, 0, 0], rtol=1e-3)  # of the luminance that it had
    assert bulb.position.tolist() == [0, 0.75, 0]
    assert not sun.intensity.any()
    assert made.said == ("lamp bulb 4.702, 0, 0 instead of 2, 2, 2", "lamp bulb moved by 0, 0.25, 0", "lamp sun off")
    assert not made.reshaped  # no triangle has moved
    assert made.scene.meshes == scene.meshes


def test_a_pattern_takes_both_kinds(scene):
    made = changed(scene, **{"*": 2})
    assert made.scene.punctual[0].intensity.tolist() == [4, 4, 4]
    light = next(mesh for mesh in made.scene.meshes if mesh.name == "light")
    before = next(mesh for mesh in scene.meshes if mesh.name == "light")
    np.testing.assert_array_equal(light.radiance, before.radiance * 2)


def test_a_room_that_they_alone_light(scene):
    dark = replace(scene, meshes=[replace(mesh, radiance=None) for mesh in scene.meshes])
    assert changed(dark, bulb=False).scene.features.has_light
    with pytest.raises(InputError, match="it leaves no light in the scene"):
        changed(dark, **{"*": False})


@pytest.mark.parametrize(
    ("lamps", "sentence"),
    [
        ({"bulb": {"radiance": [1, 1, 1]}}, "bulb is a point light and has no radiance; give a scale"),
        ({"sun": {"move": [1, 0, 0]}}, "sun is a directional light, which has no place to move from"),
        ({"bulbs": 2}, "there is no lamp bulbs; did you mean bulb"),
        ({"bulb": {"scale": -1}}, "scale is -1"),
        ({"bulb": 1e17}, "the intensity of bulb then is 2e"),
        ({"left": 2}, "mesh left is no lamp; there are light, bulb, sun"),
    ],
)
def test_what_cannot_be_done(scene, lamps, sentence):
    with pytest.raises(InputError, match=sentence):
        changed(scene, **lamps)


def test_another_light_is_told_from_the_one_of_a_fit(scene):
    kept = light_of(scene)
    assert light_changes(kept, scene) == []
    made = changed(scene, bulb=2, sun=False).scene
    assert light_changes(kept, made) == ["light bulb 4, 4, 4 instead of 2, 2, 2", "light sun off instead of 1, 1, 1"]
    turned = replace(scene.punctual[1], direction=np.float32([0, -1, 0.1]))
    assert light_changes(kept, replace(scene, punctual=(scene.punctual[0], turned))) == ["light sun moved or turned"]
    assert light_changes(kept, replace(scene, punctual=()))[0] == "light bulb off instead of 2, 2, 2"
