"""An edited scene in Mitsuba 3 looks as it does here: lamps, environment, materials and things that are put in."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from helpers.pathtraced import paths

from neurad.formats.edits.edit import edited
from neurad.formats.edits.edit_file import edit_of
from neurad.formats.mitsuba.plugin import to_mitsuba
from neurad.images.image_io import write_exr
from neurad.integrators.film import render
from neurad.scene.builtin import build

SIZE, SPP, PARTS = 16, 64, 8


def test_the_same_edit_in_mitsuba(mi, tmp_path):
    """A Cornell box without its ceiling under a sky that differs all round: both renderers' means of a view and of its
    quarters agree within five standard errors of theirs, which several passes tell, and within 2 %.
    """
    sky = np.random.default_rng(3).random((6, 12, 3), np.float32) ** 4 * 3.0
    write_exr(tmp_path / "sky.exr", sky, half=False)
    trimesh.creation.icosphere(2).export(tmp_path / "ball.glb")
    scene = build("cornell")
    scene = replace(scene, meshes=[m for m in scene.meshes if m.name != "ceiling"])
    ball = {"file": "ball.glb", "at": [0.3, -0.4, 0.2], "size": 0.6, "albedo": [0.8, 0.3, 0.1], "roughness": 0.3}
    tree = {
        "lamps": {"light": {"color": [1.0, 0.5, 0.2], "scale": 0.3, "move": [0.3, -0.2, 0.1]}},
        "environment": {"file": "sky.exr", "turn": 70},
        "materials": {"floor": {"albedo": [0.2, 0.6, 0.3]}},
        "objects": [ball],
    }
    made = edited(scene, edit_of(tree, folder=tmp_path)).scene
    view = made.test[0]
    view = replace(view, camera=replace(view.camera, width=SIZE, height=SIZE))
    theirs = to_mitsuba(made, view, SIZE, SPP)
    other = np.stack([np.asarray(mi.render(theirs, spp=SPP, seed=i))[..., :3] for i in range(PARTS)])
    tracer = paths(made)
    ours = np.stack([render(view.camera, tracer, SPP, i) for i in range(PARTS)])
    half = SIZE // 2
    for rows, columns in ((0, 0), (0, half), (half, 0), (half, half)):
        a, b = (x[:, rows : rows + half, columns : columns + half].mean((1, 2)) for x in (ours, other))  # [PARTS, 3]
        error = np.hypot(a.std(0, ddof=1), b.std(0, ddof=1)) / np.sqrt(PARTS)
        assert (np.abs(a.mean(0) - b.mean(0)) < 5.0 * error + 0.005 * b.mean(0)).all()
    assert ours.mean() == pytest.approx(other.mean(), rel=0.02)
