"""Which meshes shine: all lamps of a small white room and nothing else, whatever its file says."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.lamp_room import CEILING, DOWNWARDS, SIZE, STRIP, Photographs, lamp_room, names, photographed, turned
from helpers.object_scene import sky

from neurad.assembly.build import build_world
from neurad.core.errors import InputError
from neurad.emitters.lights import NullEmitter
from neurad.images.development import Photography
from neurad.lamps.candidates import Candidate, one_radiance, over
from neurad.lamps.find import Search, find_lamps, found_lamps
from neurad.lamps.lit_surfaces import LitSurfaces
from neurad.lamps.surfaces import PhotographedRadiance, side_of, surface_pixels
from neurad.scene.builtin.shapes import look_at
from neurad.scene.hints import PlaceHint
from neurad.scene.shining import Shining, shining_from_state, shining_scene, shining_state, without_lamps


@pytest.fixture(scope="module")
def lit():
    """The room with both lamps and its photographs."""
    scene = lamp_room()
    return scene, photographed(scene)


def found(scene, photographs, unknown_sky=False):
    return find_lamps(scene, photographs, "embree", unknown_sky, 1)


# ---- what is found


def test_both_lamps_are_found_and_neither_the_wall_beside_nor_the_card_below(lit):
    """The card is white, small and so close to the lamp that it is brighter than all else that reflects."""
    scene, photographs = lit
    result = found(without_lamps(scene), photographs)
    assert names(scene, result.lamps) == {"ceiling lamp", "strip"}
    assert [line.split(":")[0] for line in result.lines] == ["ceiling lamp shines", "strip shines"]


def test_what_the_scene_says_is_not_looked_at(lit):
    scene, photographs = lit
    wrong = replace(
        scene,
        meshes=[replace(m, radiance=np.full(3, 9.0, np.float32) if m.name == "table" else None) for m in scene.meshes],
    )
    assert names(scene, found(wrong, photographs).lamps) == {"ceiling lamp", "strip"}


def test_a_lamp_that_is_inside_out_is_turned(lit):
    scene, photographs = lit
    result = found(turned(turned(scene, "strip"), "ceiling lamp"), photographs)
    assert names(scene, result.lamps) == {"-ceiling lamp", "-strip"}


def test_photographs_may_clip_at_the_lamps(lit):
    """At 0.8 a tenth of the brighter lamp is left; its light on the walls says how bright it is."""
    scene, photographs = lit
    result = found(scene, Photographs(photographs.pixels, 0.8))
    assert names(scene, result.lamps) == {"ceiling lamp", "strip"}
    assert [line.split(" ")[-1] == "least" for line in result.lines] == [False, True, False, True]  # errors are said
    by_name = {scene.meshes[lamp.mesh].name: lamp.radiance for lamp in result.lamps}
    np.testing.assert_allclose(by_name["ceiling lamp"], CEILING, rtol=0.1)
    np.testing.assert_allclose(by_name["strip"][1:], STRIP[1:], rtol=0.35)  # a twentieth of the light


def test_photographs_that_clip_all_say_nothing(lit):
    scene, photographs = lit
    with pytest.raises(InputError, match="no mesh shines in the photographs"):
        found(scene, Photographs(photographs.pixels, 1e-3))


def test_nothing_shines_where_no_photograph_shows_a_lamp():
    """A white sheet is not brighter than the surfaces around it, even where no light is known to come from."""
    scene = lamp_room(cameras=DOWNWARDS)
    with pytest.raises(InputError, match="no mesh shines in the photographs: none, and no patch of one, is alike"):
        found(scene, photographed(scene, 16))


def test_other_light_is_known_and_does_not_make_a_lamp():
    """Of a scene under the sky, open above: nothing shines, and that is an answer. Not knowing the sky is one too."""
    scene = lamp_room(ceiling=None, strip=None)
    open_above = [m for m in scene.meshes if m.vertices[:, 1].min() < 0.9]
    scene = replace(scene, meshes=open_above, environment=sky(), train=scene.train[:2])
    photographs = photographed(scene, 16)
    for unknown_sky in (False, True):
        result = found(scene, photographs, unknown_sky)
        assert (result.lamps, result.lines) == ([], ["no mesh shines in the photographs"])


def test_a_warning_names_light_from_nowhere():
    """The ceiling lamp is in no photograph; the strip is, and is found. Once it is told of, its light is its own."""
    scene = lamp_room(cameras=(*DOWNWARDS, look_at((0.8, 0.0, 0.4), (-1.0, 0.0, 0.45), 50.0, SIZE)))
    photographs = photographed(scene, 16)
    result = found(scene, photographs)
    assert names(scene, result.lamps) == {"strip"}
    assert "some lamp is in no photograph" in result.lines[-1]
    (lamp,) = (mesh for mesh in scene.meshes if mesh.name == "ceiling lamp")
    box = (*(lamp.vertices.min(0) - 0.01), *(lamp.vertices.max(0) + 0.01))
    told = find_lamps(scene, photographs, "embree", False, 1, hints=[PlaceHint("told", tuple(map(float, box)))])
    assert names(scene, told.lamps) == {"strip", "ceiling lamp"}
    assert not any("some lamp is in no photograph" in line for line in told.lines)
    assert any(line.startswith("ceiling lamp fills no pixel of a photograph: its radiance") for line in told.lines)
    (radiance,) = (lamp.radiance for lamp in told.lamps if scene.meshes[lamp.mesh].name == "ceiling lamp")
    assert all(
        1.0 < found / true < 2.5 for found, true in zip(radiance, CEILING, strict=True)
    )  # what walls add is unseen


def test_a_lamp_that_is_told_of_is_as_bright_as_what_it_lights_says(lit):
    """All photographs clip it so far that nothing else tells."""
    scene, photographs = lit
    (lamp,) = (mesh for mesh in scene.meshes if mesh.name == "ceiling lamp")
    box = (*(lamp.vertices.min(0) - 0.01), *(lamp.vertices.max(0) + 0.01))
    dim = Photographs(photographs.pixels, 0.5)
    told = find_lamps(scene, dim, "embree", False, 1, hints=[PlaceHint("told", tuple(map(float, box)))])
    (radiance,) = (one.radiance for one in told.lamps if scene.meshes[one.mesh].name == "ceiling lamp")
    np.testing.assert_allclose(radiance, CEILING, rtol=0.2)


# ---- the parts


def test_a_white_sheet_shows_the_albedo_of_what_reflects(lit):
    """Photographed over white: the true albedo of each surface, within what cells and noise leave."""
    scene, photographs = lit
    dark = without_lamps(scene)
    shown = LitSurfaces(dark, build_world(dark, lights=NullEmitter()), photographs, 1)
    Search(shown).run()
    albedo = {i: float(scene.materials[m.material].albedo.value[0]) for i, m in enumerate(scene.meshes)}
    sides = [2 * i for i, m in enumerate(scene.meshes) if "lamp" not in m.name and m.name != "strip"]
    groups = [shown.pixels[shown.pixels.side == side] for side in sides]
    for side, group, pair in zip(sides, groups, shown.sheets(groups), strict=True):
        if len(group) > 100:
            assert over(*pair) == pytest.approx(albedo[side // 2], rel=0.15), scene.meshes[side // 2].name
    assert shown.level([]) < 1.1


def test_photographed_radiance_is_that_of_its_own_side_or_nothing(lit):
    scene, photographs = lit
    world = build_world(scene)
    pixels = surface_pixels(world, [v.camera for v in scene.train], photographs, 0)
    assert len(pixels) > 2000
    radiance = PhotographedRadiance(world.geometry, pixels)
    si = pixels.si
    torch.testing.assert_close(side_of(world.geometry, si), pixels.side)
    torch.testing.assert_close(si.prim, pixels.prims[:, 0])
    shown = radiance(si)
    assert float((shown - pixels.color).abs().mean()) < 0.1 * float(pixels.color.mean())
    behind = replace(si, wo=-si.wo)
    assert float(radiance(behind)[pixels.side == 0].abs().max()) == 0.0
    radiance.left_out[:] = True
    assert float(radiance(si).abs().max()) == 0.0


def test_large_photographs_are_looked_at_in_part_and_where_they_are_bright(lit, monkeypatch):
    scene, photographs = lit
    monkeypatch.setattr("neurad.lamps.surfaces.MAX_PIXELS", 5 * 200)
    world = build_world(scene)
    pixels = surface_pixels(world, [v.camera for v in scene.train], photographs, 0)
    assert 500 < len(pixels) <= 1000
    assert names(scene, found(scene, photographs).lamps) == {"ceiling lamp", "strip"}


def test_one_radiance_and_what_can_be_reflected_explain_a_lamp():
    ramp = torch.linspace(0, 1, 100, dtype=torch.float64)
    lamp, half = 2.0 + 0.05 * ramp, torch.full((100,), 0.5, dtype=torch.float64)
    assert one_radiance(lamp, half, 4.0)
    assert one_radiance(2.0 + 0.8 * ramp, ramp, 3.0)  # where more arrives, more comes back
    assert not one_radiance(2.0 + 0.8 * (1 - ramp), ramp * 0.1, 3.0)  # brighter where nothing arrives
    assert not one_radiance(1.0 + ramp, half, 3.0)
    assert one_radiance(1.0 + 0.2 * ramp, 0.7 + 0 * ramp, 1.5)
    assert not one_radiance(1.0 + 0.5 * ramp, 0.7 + 0 * ramp, 1.5)  # nearly white, and not alike


def test_found_lamps_shine_to_the_front_alone_and_are_kept_as_plain_types(lit):
    scene = lit[0]
    index = {m.name: i for i, m in enumerate(scene.meshes)}
    lamps = [Shining(index["table"]), Shining(index["card"], turned=True)]
    made = shining_scene(scene, lamps)
    assert [m.name for m in made.meshes if m.radiance is not None] == ["card", "table"]
    card, before = made.meshes[index["card"]], scene.meshes[index["card"]]
    np.testing.assert_array_equal(card.faces, before.faces[:, [0, 2, 1]])
    assert [m.name for m in made.meshes if not m.radiance_known] == ["card", "table"]
    assert shining_from_state(shining_state(lamps), scene, "run") == lamps
    state = shining_state(lamps)
    for bad in (None, [0], [{"mesh": 0}], [{**state[0], "mesh": True}], [state[0], state[0]], "x"):
        with pytest.raises(InputError, match="run: the checkpoint does not say which meshes shine"):
            shining_from_state(bad, scene, "run")
    with pytest.raises(InputError, match="are not meshes of scene room"):
        shining_from_state(shining_state([Shining(99)]), scene, "run")


@pytest.mark.parametrize("gains", [(2.0, 1.0, 0.5, 1.0, 1.0), (0.25, 1.0, 2.0, 1.0, 4.0)])
def test_photographs_of_unlike_exposures_are_made_alike_first(lit, gains):
    """A lamp has one radiance in all of them."""
    scene, photographs = lit
    unlike = Photographs(photographs.pixels * torch.tensor(gains).view(-1, 1, 1))
    unknown = replace(without_lamps(scene), photography=Photography(exposure="fit"))
    result = found(unknown, unlike)
    assert names(scene, result.lamps) == {"ceiling lamp", "strip"}
    assert not any(line.startswith("warning") for line in result.lines)
    try:
        as_they_are = names(scene, found(without_lamps(scene), unlike).lamps)
    except InputError:
        as_they_are = set()
    assert as_they_are != {"ceiling lamp", "strip"}


def test_of_a_lamp_that_shines_to_both_sides_the_brighter_counts(lit):
    scene, photographs = lit
    dark = without_lamps(scene)
    shown = LitSurfaces(dark, build_world(dark, lights=NullEmitter()), photographs, 1)
    pixels = shown.pixels[:4]
    shown.lamps = [
        Candidate(6, pixels, torch.full((3,), 1.0), False),
        Candidate(7, pixels, torch.full((3,), 2.0), False),
    ]
    result = found_lamps(shown, 1.0)
    assert result.lamps == [Shining(3, True)]
    assert "only the light of the brighter side" in result.lines[1]


@pytest.mark.parametrize("known", [False, True])
def test_a_lamp_that_some_photographs_clip_is_found_in_the_others(lit, known):
    """Of unlike exposures the ceilings are as unlike; a lamp at them is not alike all over."""
    scene, photographs = lit
    gains = torch.tensor([1.0, 1.0, 4.0, 1.0, 4.0]).view(-1, 1, 1)
    taken = Photographs(photographs.pixels * gains, 7.0)
    if known:
        taken.pixels, taken.ceiling = taken.pixels / gains, 7.0 / gains
        taken.clipped = lambda view, pixel: taken.colors(view, pixel) >= taken.ceiling[view, 0] * (1 - 1e-6)
    unknown = without_lamps(scene) if known else replace(without_lamps(scene), photography=Photography(exposure="fit"))
    assert names(scene, found(unknown, taken).lamps) == {"ceiling lamp", "strip"}
