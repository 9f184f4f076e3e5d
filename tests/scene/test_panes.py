"""Glass of a single sheet is told; panes with two sides and closed glass are not."""

import numpy as np
import pytest

from neurad.core.reflection import ConductorModel, DielectricModel
from neurad.core.scene_records import Constant, Material, Mesh
from neurad.formats.load import read_folder
from neurad.scene.description import Scene
from neurad.scene.panes import closed_made_solid, pane_note, single_sheets

SQUARE = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], np.float32)
TRIANGLES = np.array([[0, 1, 2], [0, 2, 3]])
CUBE = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float32)
SIDES = np.array([[0, 1, 3], [0, 3, 2], [4, 7, 5], [4, 6, 7], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6],
                  [0, 6, 4], [1, 5, 7], [1, 7, 3]])  # fmt: skip
GLASS = Material("glass", DielectricModel(), Constant(np.ones(3, np.float32)), Constant(np.zeros(1, np.float32)))
THIN = Material("sheet", DielectricModel(thin=True), GLASS.albedo, GLASS.roughness)
MIRROR = Material("mirror", ConductorModel(), Constant(np.ones(3, np.float32)), Constant(np.zeros(1, np.float32)))


def sheet(step=0.0, back=False, name="pane", material=0):
    faces = TRIANGLES[:, ::-1] if back else TRIANGLES
    return Mesh(name, SQUARE + np.float32([0, 0, step]), np.ascontiguousarray(faces), material)


def joined(*meshes):
    first = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = np.concatenate([mesh.faces + start for mesh, start in zip(meshes, first, strict=False)])
    return Mesh(meshes[0].name, np.concatenate([mesh.vertices for mesh in meshes]), faces, 0)


def found(*meshes):
    return single_sheets(meshes, [GLASS, MIRROR, THIN])


def test_single_sheets_are_named_and_panes_of_two_sides_closed_glass_and_mirrors_are_not():
    assert found(sheet()) == ["pane"]
    assert found(sheet(), sheet(2.0, back=True, name="opposite window")) == ["pane", "opposite window"]
    assert found(joined(sheet(), sheet(2.0, back=True))) == ["pane"]  # two windows of one mesh
    assert found(sheet(), sheet(0.01, name="same side")) == ["pane", "same side"]
    assert found(Mesh("open box", CUBE, SIDES[2:], 0)) == ["open box"]

    assert found(Mesh("block", CUBE * np.float32([1, 1, 0.01]), SIDES, 0)) == []
    assert found(sheet(), sheet(-0.01, back=True, name="back")) == []
    assert found(joined(sheet(), sheet(-0.01, back=True))) == []
    assert found(sheet(material=1)) == []
    assert found(sheet(material=2)) == []
    assert pane_note(Scene("room", [sheet(material=1)], [GLASS, MIRROR])) == []


def test_of_glass_that_may_be_thin_single_sheets_stay_so():
    block = Mesh("block", CUBE * np.float32([1, 1, 0.01]) + 3, SIDES, 0)
    meshes, materials = closed_made_solid([sheet(), block], [THIN, MIRROR])
    assert [materials[mesh.material].model for mesh in meshes] == [THIN.model, GLASS.model]
    pane = [sheet(), sheet(-0.01, back=True, name="back")]
    meshes, materials = closed_made_solid(pane, [THIN])
    assert [materials[mesh.material].model for mesh in meshes] == [GLASS.model, GLASS.model]


def test_a_scene_says_so(tmp_path):
    pytest.importorskip("mitsuba")
    (tmp_path / "scene.xml").write_text(
        '<scene version="3.0.0"><shape type="rectangle" id="pane"><bsdf type="dielectric"/></shape>'
        '<shape type="cube" id="block"><bsdf type="dielectric"/></shape></scene>'
    )
    (tmp_path / "cameras.json").write_text(
        '{"camera_angle_x": 1, "w": 4, "h": 4, "frames": [{"file_path": "a", "transform_matrix": '
        "[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]]}]}"
    )
    (note,) = [note for note in read_folder(tmp_path).notes if "single sheet" in note]
    assert "(pane)" in note
