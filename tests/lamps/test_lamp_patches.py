"""Lamps inside one mesh: which triangles of a scan shine."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.lamp_room import DOWNWARDS, Photographs, in_one_mesh, lamp_room, photographed, scanned, shining_area

from neurad.assembly.build import build_world
from neurad.assembly.settings import Lighting
from neurad.core.errors import InputError
from neurad.core.scene_records import Mesh
from neurad.emitters.lights import NullEmitter
from neurad.lamps import find
from neurad.lamps.candidates import reflectance
from neurad.lamps.find import find_lamps
from neurad.lamps.patches import Patches, stable_patches
from neurad.scene.builtin.plain import diffuse
from neurad.scene.description import Scene
from neurad.scene.hints import PlaceHint
from neurad.scene.shining import Shining, shining_from_state, shining_scene, shining_state


@pytest.fixture(scope="module")
def joined():
    """The room with two lamps, all its meshes joined, their photographs, and the mesh that each triangle was of."""
    scene = lamp_room()
    dark, mesh = in_one_mesh(scene)
    names = [m.name for m in scene.meshes]
    return dark, photographed(scene), mesh, [names.index("ceiling lamp"), names.index("strip")]


@pytest.fixture(scope="module")
def scan():
    """A welded scan, photographs of it, and which lamp each triangle is of."""
    dark, lit, lamp = scanned(24)
    return dark, photographed(lit, 16), lamp


def found(scene, photographs, told=()):
    places = [PlaceHint("model.lighting.lamps", tuple(place)) for place in told]
    return find_lamps(scene, photographs, "embree", False, 1, hints=places)


def test_lamps_that_are_joined_with_the_room_are_found_to_the_triangle(joined):
    scene, photographs, mesh, lamps = joined
    result = found(scene, photographs)
    assert sorted(lamp.triangles for lamp in result.lamps) == [tuple(np.flatnonzero(mesh == i)) for i in sorted(lamps)]
    assert [line.split(":")[0] for line in result.lines] == ["scan_lamp_1 shines", "scan_lamp_2 shines"]


def test_lamps_of_a_welded_scan_end_where_photographs_say(scan):
    scene, photographs, lamp = scan
    result = found(scene, photographs)
    assert len(result.lamps) == 2
    area, shines = shining_area(scene, result.lamps)
    for true in (1, 2):
        assert area[shines & (lamp == true)].sum() > 0.85 * area[lamp == true].sum()
    assert area[shines & (lamp == 0)].sum() < 0.06 * area[lamp > 0].sum()


def test_a_scan_whose_lamps_are_clipped_gives_them_up_as_well(scan):
    """At 1.2 a fifth of the brighter lamp is left, so that pixels that it fills in part look full."""
    scene, photographs, lamp = scan
    result = found(scene, Photographs(photographs.pixels, 1.2))
    area, shines = shining_area(scene, result.lamps)
    assert any("at least" in line for line in result.lines)
    assert area[shines & (lamp == 1)].sum() > 0.85 * area[lamp == 1].sum()
    assert area[shines & (lamp == 0)].sum() < 0.45 * area[lamp > 0].sum()


def test_a_clipped_lamp_whose_light_is_taken_for_that_of_another_shines(joined, monkeypatch):
    """Nothing that is known to shine makes it as bright as it is."""
    scene, photographs, mesh, lamps = joined
    strip = torch.from_numpy(mesh == lamps[1])

    def by_one_alone(lit, *_):
        lit.doubt = torch.where(strip, torch.nan, 0.1)
        lit.needed = torch.where(strip, 0.0, 1.0)[:, None].expand(-1, 3).clone()

    monkeypatch.setattr(find, "brighten", by_one_alone)
    result = found(scene, Photographs(photographs.pixels, 1.2))
    assert sorted(lamp.triangles for lamp in result.lamps) == [tuple(np.flatnonzero(mesh == i)) for i in sorted(lamps)]
    assert any(line.startswith("scan_lamp_2 shines: it is at least") for line in result.lines)


@pytest.mark.parametrize(("left", "whole"), [(0.1, False), (0.8, True)])
def test_a_lamp_is_all_of_its_part_unless_an_edge_lies_in_it(left, whole):
    """Triangles along its borders are shown with what is beside them; the left third is another thing, or is not."""
    side = 6
    x, y = (values.ravel() for values in np.meshgrid(np.arange(side + 1.0), np.arange(side + 1.0)))
    corner = (np.arange(side) + (side + 1) * np.arange(side)[:, None]).ravel()
    first, second = (corner[:, None] + np.array(way) for way in ((0, 1, side + 2), (0, side + 2, side + 1)))
    faces = np.concatenate((first, second)).astype(np.int32)
    panel = Mesh("panel", np.stack((x, y, 0 * x), -1).astype(np.float32), faces, 0)
    patches = Patches(build_world(Scene("panel", [panel], [diffuse("grey", 0.5)]), lights=NullEmitter()).geometry, None)
    middle = np.stack((x, y), -1)[faces].mean(1)
    border = np.abs(middle - side / 2).max(1) > side / 2 - 1
    patches._mean = {False: np.where(middle[:, 0] < side / 3, left, np.where(border, 0.7, 1.0))}
    inside = torch.from_numpy(patches._mean[False] == 1.0)
    found = patches.refined(inside, torch.ones(len(faces), dtype=torch.bool), back=False, radiance=1.0)
    assert found[inside].all()
    assert found.all() == whole
    assert found[torch.from_numpy(middle[:, 0] < side / 3)].any() == whole


def test_a_lamp_of_one_triangle_is_found():
    scene = lamp_room(strip=None)
    index = [m.name for m in scene.meshes].index("ceiling lamp")
    lamp = scene.meshes[index].of_triangles(np.array([0]))
    scene = replace(scene, meshes=[*scene.meshes[:index], lamp, *scene.meshes[index + 1 :]])
    dark, mesh = in_one_mesh(scene)
    (shining,) = found(dark, photographed(scene)).lamps
    assert shining.triangles == tuple(np.flatnonzero(mesh == index))


def test_a_lamp_that_is_inside_out_in_the_scan_is_turned(joined):
    scene, photographs, mesh, lamps = joined
    faces = scene.meshes[0].faces.copy()
    faces[mesh == lamps[0]] = faces[mesh == lamps[0]][:, [0, 2, 1]]
    turned = replace(scene, meshes=[replace(scene.meshes[0], faces=faces)])
    result = found(turned, photographs)
    assert {(lamp.turned, lamp.triangles) for lamp in result.lamps} == {
        (True, tuple(np.flatnonzero(mesh == lamps[0]))), (False, tuple(np.flatnonzero(mesh == lamps[1])))
    }  # fmt: skip


def test_no_patch_shines_where_no_photograph_shows_a_lamp():
    scene = lamp_room(cameras=DOWNWARDS)
    with pytest.raises(InputError, match="no mesh shines in the photographs: none, and no patch of one, is alike"):
        found(in_one_mesh(scene)[0], photographed(scene, 16))


# ---- what the user says


def test_a_box_says_what_shines_where_no_photograph_shows_it():
    scene = lamp_room(cameras=DOWNWARDS)
    dark, mesh = in_one_mesh(replace(scene, origin=(1.0, 2.0, 3.0)))
    box = [-0.4 + 1.0, 0.98 + 2.0, 0.4 + 3.0, 0.4 + 1.0, 0.995 + 2.0, -0.4 + 3.0]
    result = found(dark, photographed(scene, 16), [box])
    (lamp,) = result.lamps
    assert lamp.triangles == tuple(np.flatnonzero(mesh == [m.name for m in scene.meshes].index("ceiling lamp")))
    assert not lamp.turned
    assert result.lines[0] == "scan_lamp_1 shines: as model.lighting.lamps says"


def test_a_point_says_that_the_patch_around_it_shines(scan):
    scene, photographs, lamp = scan
    result = found(scene, photographs, [[-1.0, 0.0, 0.4]])
    assert "scan_lamp_2 shines: as model.lighting.lamps says" in result.lines
    area, shines = shining_area(scene, result.lamps[1:])
    assert area[shines & (lamp == 2)].sum() > 0.85 * area[lamp == 2].sum()
    assert area[shines & (lamp != 2)].sum() < 0.2 * area[lamp == 2].sum()


def test_what_was_found_is_not_found_again(joined):
    scene, photographs, mesh, lamps = joined
    result = found(scene, photographs, [[0.1, 0.99, 0.0], [0.4, 0.98, -0.4, -0.4, 0.995, 0.4]])
    assert sorted(lamp.triangles for lamp in result.lamps) == [tuple(np.flatnonzero(mesh == i)) for i in sorted(lamps)]


def test_a_place_where_nothing_is_gets_one_sentence(scan):
    scene, photographs, _ = scan
    with pytest.raises(InputError, match=r"model.lighting.lamps: 5, 5, 5, 6, 6, 6: no triangle lies within this box"):
        found(scene, photographs, [[5, 5, 5, 6, 6, 6]])
    with pytest.raises(InputError, match="give three numbers for a point"):
        Lighting(emitters="find", lamps=[[1.0, 2.0]])
    with pytest.raises(InputError, match="choose emitters find"):
        Lighting(emitters="fit", lamps=[[1.0, 2.0, 3.0]])


# ---- the parts


def strip(light):
    """Corners of triangles in a row, the light of each, and a hundred pixels that show each."""
    corner = np.arange(len(light))[:, None] + np.arange(3)
    return corner, np.array(light, float), np.full(len(light), 100.0)


def test_a_patch_is_what_stays_the_same_while_the_level_falls():
    slope = np.geomspace(0.5, 2.0, 60)
    light = [*slope, 8.0, 7.0, 8.0, np.nan, 0.5, 3.0, 3.1, 0.4]
    patch = stable_patches(*strip(light), 3)
    assert (patch[60:63] == patch[60]).all()
    assert (patch == patch[60]).sum() == 3
    assert (patch == patch[65]).sum() == 2
    assert patch[63] == -1
    assert (stable_patches(*strip([np.nan, 0.0]), 3) == -1).all()


def test_what_few_pixels_show_is_no_patch_by_itself():
    corner, light, _ = strip([1.0, 9.0, 1.0, 1.0])
    few = stable_patches(corner, light, np.array([90.0, 2.0, 90.0, 90.0]), 3)
    assert few[1] == few[0]
    enough = stable_patches(corner, light, np.array([90.0, 3.0, 90.0, 90.0]), 3)
    assert enough[1] != enough[0]


def test_what_a_lamp_reflects_is_by_how_much_it_is_brighter_where_more_arrives():
    generator = torch.Generator().manual_seed(0)
    white = 1.0 + 0.2 * torch.rand(2000, generator=generator, dtype=torch.float64)
    noise = 0.1 * torch.randn(3, 2000, generator=generator, dtype=torch.float64)
    sheets = white + noise[:2]
    assert reflectance(5.0 + 0.3 * white + 0.01 * noise[2], sheets, 0.9) == pytest.approx(0.3, abs=0.06)
    assert reflectance(5.0 - 0.5 * white, sheets, 0.9) < 0.1
    assert reflectance(5.0 + 90.0 * noise[2], sheets, 0.9) == pytest.approx(0.9, abs=0.1)
    assert reflectance(5.0 + white[:63], sheets[:, :63], 0.4) == 0.4  # few pixels
    assert reflectance(5.0 + white, torch.ones_like(sheets), 0.4) == 0.4  # as much arrives everywhere


def test_patches_become_meshes_and_the_rest_stays(joined):
    scene, _, mesh, lamps = joined
    inside = tuple(np.flatnonzero(mesh == lamps[0]).tolist())
    shining = [Shining(0, False, inside, 0.25, (4.0, 3.0, 2.0)), Shining(0, True, (0, 1))]
    made = shining_scene(scene, shining)
    assert [m.name for m in made.meshes] == ["scan", "scan_lamp_1", "scan_lamp_2"]
    assert [m.radiance is None for m in made.meshes] == [True, False, False]
    assert [m.radiance.tolist() for m in made.meshes[1:]] == [[4.0, 3.0, 2.0], [1.0, 1.0, 1.0]]
    assert sum(len(m.faces) for m in made.meshes) == len(mesh)
    ceiling = made.meshes[1]
    np.testing.assert_array_equal(
        ceiling.vertices[ceiling.faces], scene.meshes[0].vertices[scene.meshes[0].faces[mesh == lamps[0]]]
    )
    assert made.materials[ceiling.material].albedo.value == pytest.approx([0.25] * 3)
    assert made.meshes[2].material == made.meshes[0].material == 0
    turned = made.meshes[2]
    np.testing.assert_array_equal(
        turned.vertices[turned.faces], scene.meshes[0].vertices[scene.meshes[0].faces[:2][:, [0, 2, 1]]]
    )
    assert shining_from_state(shining_state(shining), scene, "run") == shining
    for bad in (
        {"mesh": "0"},
        {"turned": 2},
        {"triangles": [0.5]},
        {"triangles": [-1]},
        {"albedo": 2.0},
        {"radiance": [0.0] * 3},
    ):
        with pytest.raises(InputError, match="run: the checkpoint does not say which meshes shine"):
            shining_from_state([{**shining_state(shining)[0], **bad}], scene, "run")
    with pytest.raises(InputError, match="are not meshes of scene"):
        shining_from_state(shining_state([Shining(0, False, (10**6,))]), scene, "run")


def test_a_mesh_that_is_all_lamps_leaves_nothing():
    scene = lamp_room()
    quad = scene.meshes[0]
    two = Mesh("panel", quad.vertices, quad.faces, 0)
    made = shining_scene(
        replace(scene, meshes=[two, *scene.meshes[1:]]), [Shining(0, False, (0,)), Shining(0, False, (1,))]
    )
    assert [len(m.faces) for m in made.meshes if m.radiance is not None] == [1, 1]
    assert made.meshes[0].name == "panel_lamp_1"
    assert made.meshes[-1].name == "panel_lamp_2"
    assert made.check() is made
