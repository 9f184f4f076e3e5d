"""Rooms of other people as glTF: the shared ones, written by the tests' own writer, and the files that assimp is tested
with.
"""

import math
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.gltf_rooms import shown, written
from helpers.pathtraced import picture

from neurad.core.errors import InputError
from neurad.formats.gltf.gltf_scene import read_scene
from neurad.formats.gltf.read import read_gltf
from neurad.formats.load import read_folder

ROOMS = Path(__file__).resolve().parents[3] / "shared" / "scenes"
ASSIMP = Path(os.environ.get("NEURAD_ASSIMP", "/usr/share/assimp/models"))
"""Where Debian's assimp-testmodels puts its files, or where they lie instead."""


@pytest.mark.slow
@pytest.mark.parametrize("room", ["veach-ajar", "staircase", "living-room-2", "kitchen", "bunny"])
def test_shared_rooms(room, tmp_path):
    """Triangles and lamps as in ``scene.xml`` to what float32 keeps, and the same picture but for its noise."""
    pytest.importorskip("mitsuba")
    if not (ROOMS / room).is_dir():
        pytest.skip("the shared scenes are not here")
    scene = read_folder(ROOMS / room)
    scene = replace(scene, materials=[shown(material) for material in scene.materials])
    again = read_scene(written(scene, tmp_path / "room.glb"))
    again = replace(again, environment=scene.environment)
    extent = float(np.ptp(scene.bounds, axis=0).max())
    assert [len(mesh.faces) for mesh in again.meshes] == [len(mesh.faces) for mesh in scene.meshes]
    for mesh, found in zip(scene.meshes, again.meshes, strict=True):
        corners, there = mesh.vertices[mesh.faces], found.vertices[found.faces]
        assert np.abs(corners - there).max() < 1e-6 * extent
        if mesh.radiance is not None:
            np.testing.assert_allclose(mesh.radiance, found.radiance, rtol=1e-6)
    np.testing.assert_allclose(scene.bounds, again.bounds, atol=1e-6 * extent)
    view = (*scene.test, *scene.train)[0]
    made = [(scene, 0), (scene, 1), (again, 0)]
    first, other, second = (picture(one, view.camera, 16, seed, 24, (6, 8)) for one, seed in made)
    noise = np.abs(other - first).mean()
    assert np.abs(second - first).mean() < 1.2 * noise + 0.01 * first.mean()
    assert second.mean() == pytest.approx(
        first.mean(), abs=float(0.02 * first.mean() + 3 * noise / math.sqrt(first.size))
    )


@pytest.mark.parametrize("kind", ["glTF", "glTF2"])
def test_files_that_assimp_is_tested_with(kind):
    """Each is read, or refused in one sentence that names the file."""
    files = [file for ending in ("gltf", "glb") for file in sorted((ASSIMP / kind).rglob(f"*.{ending}"))]
    if not files:
        pytest.skip("Debian's assimp-testmodels is not installed")
    read = 0
    for file in files:
        said = None
        try:
            room = read_gltf(file)
            read += 1
            assert all(np.isfinite(mesh.vertices).all() for mesh in room.meshes)
        except InputError as error:
            said = str(error)
        if said is not None:
            assert file.stem.split("_")[0] in said  # also where a file beside it is missing
            assert "\n" not in said
    assert (read > 0) == (kind == "glTF2")
