"""Meshes of all kinds are baked, valid for others and rendered again."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.exported import Glb, corners_of, exported
from helpers.odd_meshes import KINDS, loose
from helpers.pathtraced import picture
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from neurad.core.reflection import PrincipledModel
from neurad.core.scene_records import Constant, Material
from neurad.formats.mitsuba.read import read_xml
from neurad.scene.builtin.plain import views
from neurad.scene.builtin.shapes import quad
from neurad.scene.description import Scene

pytest.importorskip("xatlas")
pytest.importorskip("mitsuba")

SEEDS = st.integers(0, 1 << 16)
SOME = settings(max_examples=4, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))


def scene_of(meshes):
    """The meshes below a lamp, seen by two cameras."""
    half, rough = Constant(np.full(3, 0.5, np.float32)), Constant(np.full(1, 0.4, np.float32))
    paint = Material("paint", PrincipledModel(), half, rough)
    lamp = quad((-1, 3, -1), (2, 0, 0), (0, 0, 2)).mesh("lamp", 0, radiance=np.array([1.5, 2.0, 3.0], np.float32))
    named = [replace(mesh, name=f"{i}/ä {mesh.name}") for i, mesh in enumerate(meshes)]  # no name of a file
    eyes = [((0.5, 1.0, 4.0), (0.5, 0.5, 0.0)), ((-3.0, 1.5, 1.0), (0.5, 0.5, 0.0))]
    seen = {"train": views("train", eyes, 60.0, 16), "test": views("test", eyes[:1], 60.0, 16)}
    return Scene("odd", [*named, lamp], [paint], max_depth=4, **seen).check()


def check(meshes, folder, validator):
    """Export a scene of these meshes, and look at what came out."""
    scene = scene_of(meshes)
    room = exported(scene, folder / "room", overwrite=True)
    assert validator.issues(room / "scene.glb") == []
    found = list(Glb(room / "scene.glb").meshes())
    again = read_xml(room / "scene.xml").check()
    for mesh, (_, corners, _), read in zip(scene.meshes, found, again.meshes, strict=True):
        assert np.array_equal(corners.view(np.uint32), corners_of(mesh).view(np.uint32)), mesh.name
        assert np.array_equal(corners_of(read), corners_of(mesh)), mesh.name
    shown = picture(again, scene.test[0].camera, 1, 7)
    assert np.isfinite(shown).all()
    assert shown.min() >= 0.0


def test_every_kind_together(tmp_path, validator):
    rng = np.random.default_rng(0)
    meshes = [replace(make(rng), name=name) for name, make in KINDS.items()]
    check([*meshes, replace(loose(rng, 2000), name="many")], tmp_path, validator)


@SOME
@given(SEEDS, st.lists(st.sampled_from(sorted(KINDS)), min_size=1, max_size=4))
def test_any_few(tmp_path, validator, seed, kinds):
    rng = np.random.default_rng(seed)
    check([replace(KINDS[kind](rng), name=kind) for kind in kinds], tmp_path, validator)
