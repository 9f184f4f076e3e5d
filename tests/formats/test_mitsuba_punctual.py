"""Lights without extent and curved shapes of Mitsuba's scene files: read, written, and refused."""

import math
from dataclasses import replace

import numpy as np
import pytest
from helpers.tiny_scene import XML, write_scene

from neurad.core.errors import InputError
from neurad.formats.load import load_scene
from neurad.formats.mitsuba.read import read_xml
from neurad.formats.mitsuba.shapes import ERROR
from neurad.formats.mitsuba.write import describe, write_xml
from neurad.scene.light import light_of

pytest.importorskip("mitsuba")

LIGHTS = """
  <emitter type="point" id="bulb"><point name="position" x="1" y="2" z="3"/>
    <rgb name="intensity" value="1,2,3"/></emitter>
  <emitter type="spot"><transform name="to_world"><lookat origin="0,3,0" target="0,0,1" up="1,0,0"/></transform>
    <rgb name="intensity" value="4"/><float name="cutoff_angle" value="40"/></emitter>
  <emitter type="directional" id="sun"><vector name="direction" x="0" y="-2" z="0"/></emitter>
  <emitter type="directional"><transform name="to_world"><rotate x="1" angle="90"/></transform></emitter>
"""


def read(folder, more, shapes='<shape type="rectangle"/>'):
    file = folder / "scene.xml"
    file.write_text(f'<scene version="3.0.0">{more}{shapes}</scene>')
    return read_xml(file)


def test_lights_are_read_and_written_again(tmp_path):
    scene = read(tmp_path, LIGHTS).check()
    bulb, spot, sun, other = scene.punctual
    assert [x.name for x in scene.punctual] == ["bulb", "spot-2", "sun", "directional-4"]
    assert (bulb.kind, bulb.position.tolist(), bulb.intensity.tolist()) == ("point", [1, 2, 3], [1, 2, 3])
    assert (spot.kind, spot.position.tolist(), spot.intensity.tolist()) == ("spot", [0, 3, 0], [4, 4, 4])
    assert (spot.cutoff_angle, spot.beam_width) == (40.0, 30.0)
    np.testing.assert_allclose(spot.direction, np.array([0, -3, 1]) / math.sqrt(10), atol=1e-6)
    assert (sun.direction.tolist(), sun.intensity.tolist()) == ([0, -2, 0], [1, 1, 1])
    np.testing.assert_allclose(other.direction, [0, -1, 0], atol=1e-6)
    assert scene.features.has_punctual
    assert not scene.features.has_area_lights
    (tmp_path / "again").mkdir()
    write_xml(describe(scene, tmp_path / "again"), tmp_path / "again/scene.xml")
    for light, back in zip(scene.punctual, read_xml(tmp_path / "again/scene.xml").punctual, strict=True):
        assert (back.name, back.kind, back.cutoff_angle, back.beam_width) == (
            light.name, light.kind, light.cutoff_angle, light.beam_width,
        )  # fmt: skip
        np.testing.assert_array_equal(back.intensity, light.intensity)
        np.testing.assert_array_equal(back.position, light.position if light.kind != "directional" else [0, 0, 0])
        if light.kind != "point":
            length = np.linalg.norm(light.direction)
            np.testing.assert_allclose(back.direction, light.direction / length, atol=1e-7)


def test_they_count_for_the_light_of_a_fit_and_not_for_its_geometry(tmp_path):
    scene = read(tmp_path, LIGHTS)
    brighter = replace(scene, punctual=(replace(scene.punctual[0], intensity=np.float32([9, 9, 9])),))
    assert light_of(scene) != light_of(brighter) != light_of(replace(scene, punctual=()))
    assert scene.geometry_fingerprint == brighter.geometry_fingerprint


def test_a_light_of_no_power_is_none(tmp_path):
    dark = '<emitter type="spot"><float name="intensity" value="0"/></emitter>'
    with pytest.raises(InputError, match="it has no emitter"):
        read(tmp_path, dark).check()


# ---- curved shapes


BULB = '<emitter type="point"/>'
TURN = '<rotate x="0.6" z="0.8" angle="40"/>'
CURVES = {
    "sphere": ("sphere", '<float name="radius" value="0.7"/><point name="center" x="0.1" y="0.2" z="-0.1"/>'),
    "a mirrored sphere": ("sphere", f'<transform name="to_world">{TURN}<scale x="-1"/></transform>'),
    "a sphere from inside": ("sphere", '<boolean name="flip_normals" value="true"/>'),
    "an ellipse": ("disk", f'<transform name="to_world"><scale x="1.5" y="0.5"/>{TURN}</transform>'),
    "a flipped disk": ("disk", '<boolean name="flip_normals" value="true"/>'),
    "a mirrored disk": ("disk", '<transform name="to_world"><scale z="-1"/></transform>'),
    "a pipe": ("cylinder", '<point name="p0" x="0" y="0" z="-0.5"/><point name="p1" x="0.5" y="0.3" z="1"/>'
                           '<float name="radius" value="0.6"/>'),
    "a flipped pipe": ("cylinder", '<boolean name="flip_normals" value="true"/>'),
    "a mirrored pipe": ("cylinder", '<transform name="to_world"><scale y="-1"/></transform>'),
}  # fmt: skip


@pytest.mark.parametrize("name", CURVES)
def test_curved_shapes_are_mitsubas_within_the_stated_error(mi, tmp_path, name):
    """Along rays through the shape: distance across the surface, shading normals and texture coordinates."""
    kind, inside = CURVES[name]
    scene = read(tmp_path, BULB, f'<shape type="{kind}">{inside}</shape>')
    ours = scene.meshes[0]
    assert f"it is read as {len(ours.faces)} triangles with its exact normals, at most" in scene.notes[0]
    assert ours.normals is not None
    assert ours.uvs is not None
    rng = np.random.default_rng(len(name))
    theirs = mi.load_file(str(tmp_path / "scene.xml"))
    mesh = mi.Mesh("ours", len(ours.vertices), len(ours.faces), has_vertex_normals=True, has_vertex_texcoords=True)
    values = mi.traverse(mesh)
    values["vertex_positions"], values["vertex_normals"] = ours.vertices.ravel(), ours.normals.ravel()
    values["vertex_texcoords"], values["faces"] = ours.uvs.ravel(), ours.faces.ravel().astype(np.uint32)
    values.update()
    made = mi.load_dict({"type": "scene", "mesh": mesh})
    seen, missed = [], 0
    for _ in range(400):
        o, through = 3 * rng.normal(size=3), rng.uniform(-0.8, 0.8, 3)
        d = (through - o) / np.linalg.norm(through - o)
        a, b = (x.ray_intersect(mi.Ray3f(o.tolist(), d.tolist())) for x in (theirs, made))
        missed += a.is_valid() != b.is_valid()
        if a.is_valid() and b.is_valid():
            n, turn = np.array(a.sh_frame.n), np.abs(np.array(a.uv) - np.array(b.uv))
            across = abs((a.t - b.t) * float(d @ n))
            normal = np.linalg.norm(n - np.array(b.sh_frame.n))
            seen.append((across, normal, np.minimum(turn, 1 - turn).max(), float(np.array(a.n) @ np.array(b.n))))
    across, normal, uv, side = np.array(seen).T
    assert len(seen) > 80
    assert missed <= 2  # at the silhouette
    radius = {"sphere": 0.7, "a pipe": 0.6, "an ellipse": 1.5}.get(name, 1.0)
    assert across.max() <= radius * ERROR[kind] + 2e-6
    assert np.quantile(normal, 0.97) < 5e-3  # what is left grazes, and hits another place
    assert normal.max() < 0.1
    assert uv.max() < 0.03
    assert side.min() > 0.99


def test_a_shining_sphere_sends_its_light_outwards_and_a_stretched_one_is_refused(tmp_path):
    lamp = '<shape type="sphere" id="lamp"><emitter type="area"><rgb name="radiance" value="1,2,3"/></emitter></shape>'
    scene = read(tmp_path, "", lamp).check()
    mesh = scene.meshes[0]
    p = mesh.vertices[mesh.faces].astype(np.float64)
    across = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    assert (np.einsum("fx,fx->f", across, p.mean(1)) > 0).all()
    area = 0.5 * np.linalg.norm(across, axis=1).sum()
    assert area == pytest.approx(4 * math.pi, rel=1.5e-3)

    wide = '<shape type="sphere" id="egg"><transform name="to_world"><scale x="2"/></transform></shape>'
    with pytest.raises(InputError, match=r"to_world of shape egg stretches a sphere, .*export it as a triangle mesh"):
        read(tmp_path, BULB, wide)


def test_what_was_decided_is_kept_with_the_scene(tmp_path):
    folder = write_scene(tmp_path / "room")
    (folder / "scene.xml").write_text(XML.replace("</scene>", '<shape type="disk" id="plate"/></scene>'))
    assert any("shape plate is a disk" in note for note in load_scene(str(folder), None).notes)
