"""Files of hints: what they may say, and what becomes of views and parts by it."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from neurad.assembly.left_out import without_surfaces
from neurad.core.errors import InputError
from neurad.formats.hints import add_hint, hint_entries, hinted, hints_of
from neurad.formats.load import load_scene
from neurad.images.photographs import kept_pixels
from neurad.scene.geometry import Geometry
from neurad.scene.parts import SurfaceParts
from neurad.tracing.select import make_tracer


@pytest.fixture(scope="module")
def scene():
    return load_scene(None, "patterns")


@pytest.fixture(scope="module")
def points(scene):
    """Triangle and position in the middle of some views, each on another mesh."""
    geometry = Geometry(scene)
    tracer = make_tracer("auto", geometry.vertices, geometry.faces)
    from neurad.core.camera import camera_rays

    found = {}
    for view in scene.train:
        camera = view.camera
        rays = camera_rays(camera, torch.rand(64, 2) * torch.tensor([camera.width, camera.height]))
        hit = tracer.closest(rays)
        for lane in hit.valid.nonzero().squeeze(-1).tolist():
            prim = int(hit.prim[lane])
            found.setdefault(int(geometry.mesh_index[prim]), (prim, (rays.o + hit.t[:, None] * rays.d)[lane].tolist()))
    return geometry, tracer, list(found.values())


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("- shines: [1, 2]", "entry 1: shines is .* three numbers are needed"),
        ("- shines: [1, 2, nan]", "entry 1: shines is 'nan', not a number"),
        ("- shines: [1, 2, .inf]", "entry 1: shines is inf"),
        ("- shines: [0, 0, 0]\n- leave_out: 3", "entry 2: leave_out is 3"),
        ("- shine: [0, 0, 0]", "entry 1: there is no shine, choose one of shines, one_material, leave_out"),
        ("- {shines: [0, 0, 0], leave_out: [0, 0, 0]}", "entry 1: it is"),
        ("- shines", "entry 1: it is 'shines'"),
        ("- one_material: [[0, 0, 0]]", "entry 1: one_material is .* two or more places"),
        ("- one_material: [0, 0, 0]", "entry 1: one_material is .* two or more places"),
        ("- leave_out: {view: a}", "entry 1: leave_out is .* but a view and a rectangle are needed"),
        ("- leave_out: {view: a, rectangle: [3, 0, 2, 4]}", "entry 1: leave_out: rectangle is"),
        ("- leave_out: {view: a, rectangle: [0, 0, 2.5, 4]}", "entry 1: leave_out: rectangle is"),
        ("- leave_out: {view: a, rectangle: [-1, 0, 2, 4]}", "entry 1: leave_out: rectangle is"),
        ("shines: [0, 0, 0]", "it has to be a list of entries"),
        ("- [", "it is not readable YAML"),
    ],
)
def test_bad_entries_get_one_sentence(tmp_path, text, words):
    path = tmp_path / "hints.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=rf"^--data.hints .*hints.yaml: {words}") as caught:
        hint_entries(str(path))
    assert "\n" not in str(caught.value)


def test_files_that_are_missing_or_empty(tmp_path):
    with pytest.raises(InputError, match="there is no such file of hints"):
        hint_entries(str(tmp_path / "none.yaml"))
    with pytest.raises(InputError, match=r"^--data.hints ~nosuchuser/x: .*home directory"):
        hint_entries("~nosuchuser/x")
    (tmp_path / "empty.yaml").write_text("# nothing yet\n")
    assert hint_entries(str(tmp_path / "empty.yaml")) == []


def test_entries_are_added_behind_what_stands_there(tmp_path):
    path = tmp_path / "hints.yaml"
    assert add_hint(path, {"shines": [0.5, -1e-7, 2.0]}) == 1
    path.write_text("# the bulb\n" + path.read_text().rstrip("\n"))
    assert add_hint(path, {"one_material": [[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]]}) == 2
    assert path.read_text().startswith("# the bulb\n- ")
    found = hints_of(hint_entries(str(path)))
    assert found.shines[0].place == (0.5, -1e-7, 2.0)
    assert [told.place for told in found.one_material[0]] == [(0.0, 1.0, 2.0), (3.0, 4.0, 5.0)]
    for other in ("[{shines: [0, 0, 0]}]", "- shines: [1]\n"):
        path.write_text(other)
        with pytest.raises(InputError):
            add_hint(path, {"shines": [0.0, 0.0, 0.0]})
        assert path.read_text() == other


def test_rectangles_are_left_out(scene):
    name = scene.train[1].name
    first = {"leave_out": {"view": name, "rectangle": [3, 5, 10, 7]}}
    second = {"leave_out": {"view": name, "rectangle": [0, 0, 1, 1]}}
    found = hinted(scene, [first, second])
    kept = kept_pixels(found.train[1])
    assert not kept[5:7, 3:10].any()
    assert not kept[0, 0]
    assert (~kept).sum() == 2 * 7 + 1
    assert kept_pixels(found.train[0]) is None
    masked = replace(found.train[1], left_out=found.train[1].left_out.T.copy())  # hints add up with what is there
    alone = kept_pixels(hinted(scene, [first]).train[1])
    both = kept_pixels(hinted(replace(scene, train=[masked]), [first]).train[0])
    assert np.array_equal(both, ~masked.left_out & alone)
    with pytest.raises(InputError, match="entry 1: leave_out: there is no view nowhere"):
        hinted(scene, [{"leave_out": {"view": "nowhere", "rectangle": [0, 0, 1, 1]}}])
    width = scene.train[1].camera.width
    with pytest.raises(InputError, match=f"has {width} x "):
        hinted(scene, [{"leave_out": {"view": name, "rectangle": [0, 0, width + 1, 1]}}])


def test_pixels_that_see_a_surface_are_left_out(scene, points):
    """By rays through the middles: exactly those whose part it is, and with them those that it touches."""
    geometry, tracer, places = points
    from neurad.core.camera import camera_rays

    prim, place = places[0]
    moved = replace(scene, origin=(10.0, 0.0, -3.0))
    told = [place[0] + 10.0, place[1], place[2] - 3.0]
    found = without_surfaces(hinted(moved, [{"leave_out": told}]))
    part = SurfaceParts(geometry, geometry.mesh_index)
    own = part.of(torch.arange(len(geometry.faces))) == part.of(torch.tensor([prim]))
    left = 0
    for view in (*found.train, *found.test):
        camera = view.camera
        pixel = torch.arange(camera.width * camera.height)
        xy = torch.stack((pixel % camera.width, pixel // camera.width), -1) + 0.5
        hit = tracer.closest(camera_rays(camera, xy))
        sees = (hit.valid & own[hit.prim.clamp_min(0)]).view(camera.height, camera.width).numpy()
        kept = kept_pixels(view)
        out = np.zeros_like(sees) if kept is None else ~kept
        assert out[sees].all()
        grown = np.pad(sees, 1)
        grown = np.logical_or.reduce(
            [grown[y : y + sees.shape[0], x : x + sees.shape[1]] for y in (0, 1, 2) for x in (0, 1, 2)]
        )
        assert (out & ~grown).mean() < 0.01  # thin things are seen at corners alone
        left += int(out.sum())
    assert left > 0
    triangle = geometry.vertices[geometry.faces[prim]].numpy()
    box = [*(triangle.min(0) - 1e-4).tolist(), *(triangle.max(0) + 1e-4).tolist()]
    within = without_surfaces(hinted(scene, [{"leave_out": box}]))
    assert 0 < sum(0 if v.left_out is None else int(v.left_out.sum()) for v in (*within.train, *within.test)) <= left
    with pytest.raises(InputError, match="entry 1: leave_out: 100, 0, 0: no surface is there; the nearest is"):
        without_surfaces(hinted(scene, [{"leave_out": [100, 0, 0]}]))
    with pytest.raises(InputError, match="no triangle lies within this box"):
        without_surfaces(hinted(scene, [{"leave_out": [100, 0, 0, 101, 1, 1]}]))
