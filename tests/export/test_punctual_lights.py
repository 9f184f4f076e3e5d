"""Lights without extent in an exported room, as other programs read them."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from helpers.exported import Glb, exported

from neurad.core.records import PunctualLight
from neurad.formats.mitsuba.read import read_xml
from neurad.scene.builtin import build_cornell

LIGHTS = tuple(
    PunctualLight(name, kind, *(np.asarray(x, np.float32) for x in (rgb, at, along)), 50.0, 20.0)  # type: ignore[arg-type]
    for name, kind, rgb, at, along in (
        ("bulb", "point", (2, 1, 0.5), (0.1, 0.4, 0.2), (0, 0, 1)),
        ("beam", "spot", (1, 3, 2), (0.3, 0.9, -0.2), (0.6, -0.8, 0.0)),
        ("sun", "directional", (0.5, 0.5, 1), (0, 0, 0), (0, -0.6, -0.8)),
        ("off", "point", (0, 0, 0), (0, 0, 0), (0, 0, 1)),
    )
)


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    pytest.importorskip("xatlas")
    return exported(replace(build_cornell(), punctual=LIGHTS), tmp_path_factory.mktemp("export") / "room")


def test_gltf_has_them_in_candela_and_lux(room):
    glb = Glb(room / "scene.glb")
    assert "KHR_lights_punctual" in glb.json["extensionsUsed"]
    lights = glb.json["extensions"]["KHR_lights_punctual"]["lights"]
    nodes = {node["name"]: node for node in glb.json["nodes"] if "KHR_lights_punctual" in node.get("extensions", {})}
    assert [light["name"] for light in lights] == ["bulb", "beam", "sun"]
    for light, made in zip(LIGHTS, lights, strict=False):
        assert made["type"] == light.kind
        np.testing.assert_allclose(np.array(made["color"]) * made["intensity"] / 683, light.intensity, rtol=1e-6)
        node = nodes[light.name]
        if light.kind != "directional":
            np.testing.assert_allclose(node["translation"], light.position)
        if light.kind != "point":
            x, y, z, w = node["rotation"]
            along = -np.array([2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)])  # of -Z
            np.testing.assert_allclose(along, light.direction, atol=1e-6)
    assert lights[1]["spot"]["outerConeAngle"] == pytest.approx(math.radians(50))
    assert lights[1]["spot"]["innerConeAngle"] == pytest.approx(math.radians(20))


def test_the_validator_finds_nothing(room, validator):
    report = validator.report(room / "scene.glb")
    assert report["issues"]["numErrors"] == report["issues"]["numWarnings"] == 0, report["issues"]["messages"]


def test_mitsubas_file_has_them_exactly(room):
    pytest.importorskip("mitsuba")
    read = {light.name: light for light in read_xml(room / "scene.xml").punctual}
    for light in LIGHTS:
        back = read[light.name]
        assert back.kind == light.kind
        np.testing.assert_array_equal(back.intensity, light.intensity)
        np.testing.assert_array_equal(back.position, light.position)
        if light.kind != "point":
            np.testing.assert_allclose(back.direction, light.direction, atol=1e-7)


def test_the_notes_have_them_for_blender(room):
    notes = json.loads((room / "room.json").read_text())
    assert [light["name"] for light in notes["lights"]] == ["bulb", "beam", "sun"]
    assert notes["lights"][1]["intensity"] == [1.0, 3.0, 2.0]
    if (room / "room.usdc").exists():
        assert any("room.usdc: it lacks 3 lights" in said for said in notes["left_out"])


def test_lights_of_one_name_are_told_apart_in_all_files(tmp_path):
    """Blender finds them by names, of which it keeps 63 bytes."""
    pytest.importorskip("xatlas")
    lights = tuple(replace(light, name=name) for light, name in zip(LIGHTS, ("lamp", "lamp", "x" * 80), strict=False))
    room = exported(replace(build_cornell(), punctual=lights), tmp_path / "room")
    listed = [light["name"] for light in json.loads((room / "room.json").read_text())["lights"]]
    assert len(set(listed)) == 3
    assert max(map(len, listed)) <= 56
    glb = Glb(room / "scene.glb").json["extensions"]["KHR_lights_punctual"]["lights"]
    assert [light["name"] for light in glb] == listed
    again = read_xml(room / "scene.xml")
    assert sorted(light.name for light in again.punctual) == sorted(listed)
