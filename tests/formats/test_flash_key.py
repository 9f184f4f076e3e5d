"""The key ``flash`` of camera files: what it may say, and one sentence for what it may not."""

import json

import numpy as np
import pytest
from helpers.flash_room import flash, flash_room
from helpers.tiny_fit import fails
from helpers.tiny_scene import read_json, write_json, write_scene

from neurad.core.errors import InputError
from neurad.formats.cameras.intrinsics import read_flash
from neurad.formats.cameras.nerf import read_views
from neurad.formats.cameras.write import transforms
from neurad.formats.load import load_scene

SPOT = {"type": "spot", "intensity": [1, 2, 3], "position": [0.1, 0, 0], "direction": [0, 0, -2], "cutoff_angle": 30}


def test_what_is_left_out_is_usual():
    light = read_flash({"intensity": 4}, "f")
    assert (light.kind, light.intensity.tolist(), light.position.tolist()) == ("point", [4.0] * 3, [0.0] * 3)
    light = read_flash(SPOT, "f")
    assert (light.cutoff_angle, light.beam_width, light.direction.tolist()) == (30.0, 22.5, [0.0, 0.0, -2.0])
    assert read_flash(None, "f") is None
    assert read_flash(False, "f") is None


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"type": "point"}, "its flash has no intensity: give its power per solid angle"),
        ({"intensity": -1}, "its flash: its intensity is -1, -1, -1, which has to be numbers from 0 to 1e"),
        ({"intensity": [1, 2]}, "its intensity is [1, 2], not three numbers"),
        ({"intensity": "bright"}, "its intensity is 'bright', not a number"),
        ({"type": "area", "intensity": 1}, "its flash: its type is 'area'; there are: point, spot"),
        ({"intensity": 1, "cutoff_angle": 3}, "its flash: a point has no cutoff_angle, only intensity, position"),
        ({**SPOT, "beam_width": 31}, "its flash: its beam_width is 31, which has to be a number from 0"),
        ({**SPOT, "direction": [0, 0, 0]}, "its flash: its direction is 0, 0, 0, which points nowhere"),
        (3.0, "its flash is 3.0, not an object with a type and an intensity"),
    ],
)
def test_what_it_may_not_be_is_said(given, said):
    with pytest.raises(InputError) as refused:
        read_flash(given, "room: frame 0")
    assert said in str(refused.value)
    assert str(refused.value).startswith("room: frame 0: its flash")


def test_frames_and_file_say_it_and_it_is_written_again(tmp_path):
    scene = flash_room(flash(kind="spot"), views=2, size=8)
    described = transforms(scene.train)
    assert described["flash"]["type"] == "spot"
    described["frames"][1]["flash"] = False
    (tmp_path / "c.json").write_text(json.dumps(described))
    first, second = (view.camera.flash for view in read_views(tmp_path / "c.json", tmp_path, pictures=False))
    assert second is None
    for name in ("kind", "cutoff_angle", "beam_width"):
        assert getattr(first, name) == getattr(scene.flash, name)
    for name in ("intensity", "position", "direction"):
        np.testing.assert_allclose(getattr(first, name), getattr(scene.flash, name), rtol=1e-6)


@pytest.fixture
def folder(tmp_path):
    """A scene folder whose photographs have a flash; needs Mitsuba to read it."""
    pytest.importorskip("mitsuba")
    folder = write_scene(tmp_path / "room")
    for part in ("train", "test"):
        write_json(folder, part, {**read_json(folder, part), "flash": {"intensity": 2.0}})
    return folder


def test_a_folder_without_other_light_is_lit_by_it(folder):
    xml = (folder / "scene.xml").read_text()
    begin, end = xml.index('<emitter type="area">'), xml.index("</emitter>") + len("</emitter>")
    (folder / "scene.xml").write_text(xml[:begin] + xml[end:])
    scene = load_scene(str(folder), None)
    assert scene.features.has_flash
    assert scene.features.has_light
    assert not scene.features.has_area_lights


def test_flashes_are_of_one_type(folder, capfd):
    described = read_json(folder, "train")
    described["frames"][1]["flash"] = SPOT
    write_json(folder, "train", described)
    said = fails(capfd, "fit", "--config", "scene.yaml", "--data.root", folder)
    assert "its flashes differ in type or angles" in said


def test_lamps_beside_it_have_to_be_known(folder, capfd):
    for how in ("find", "fit"):
        said = fails(capfd, "fit", "--config", "scene.yaml", "--data.root", folder, "--model.lighting.emitters", how)
        assert "beside a flash all other lamps have to be known" in said


def test_its_power_is_found_where_there_is_one(tmp_path, capfd):
    pytest.importorskip("mitsuba")
    folder = write_scene(tmp_path / "room")
    said = fails(capfd, "fit", "--config", "scene.yaml", "--data.root", folder, "--model.lighting.flash", "fit")
    assert "model.lighting.flash is fit, but no photograph has a flash" in said
