"""``neurad check``: nothing is wrong with built-in scenes, and each damage of a copy is named."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.tables import csv_rows
from helpers.tiny_fit import fails
from trimesh.transformations import rotation_matrix

from datamodules.scene_data import SceneData
from datamodules.settings import DataSettings
from neurad.assembly.build import build_world
from neurad.cli import main
from neurad.core.scene_records import Camera
from neurad.evidence.view_residuals import few
from neurad.images.development import Photography
from neurad.images.image_io import write_exr
from neurad.images.photographs import read_photograph
from neurad.inspect.check.findings import Level
from neurad.inspect.check.geometry import FAR_OUT, POINTS, seen_points
from neurad.inspect.check.light import exposure_ratios, rendered
from neurad.inspect.check.look import photograph_facts
from neurad.inspect.check.report import write_pages
from neurad.inspect.check.run import checked_scene
from neurad.inspect.check.surroundings import both_ways, surroundings
from neurad.metrics.seen import SeenBy
from neurad.scene import builtin
from neurad.scene.builtin import build
from neurad.scene.builtin.plain import diffuse
from neurad.scene.builtin.shapes import quad
from neurad.scene.description import Scene
from neurad.scene.textures import TrueMaterials

INSIDE = (-0.35, -0.4, -0.3)
"""In the middle of the Cornell box's tall block."""


def source(scene):
    return SceneData(DataSettings(scene="cornell")).over(scene)


def turned(view, degrees):
    """The camera turned to the left about its own vertical axis."""
    return posed(view, view.camera.to_world @ rotation_matrix(math.radians(degrees), (0, 1, 0)))


def posed(view, pose):
    return replace(view, camera=replace(view.camera, to_world=np.asarray(pose, np.float32)))


def moved(view, place):
    pose = view.camera.to_world.copy()
    pose[:3, 3] = place
    return posed(view, pose)


def with_photograph(view, folder, change):
    """The view with another photograph: what ``change`` makes of its own."""
    path = folder / f"{view.name}.exr"
    write_exr(path, change(read_photograph(view.image)).astype(np.float32), half=False)
    return replace(view, image=str(path))


def brighter(scene, factor):
    """The scene with lamps so many times as bright."""
    lit = [m if m.radiance is None else replace(m, radiance=m.radiance * np.float32(factor)) for m in scene.meshes]
    return replace(scene, meshes=lit)


def said(checked):
    """For each view what is said to be wrong with it; under '' what is wrong with all."""
    found = {}
    for finding in checked.findings:
        if finding.level > Level.NOTE:
            found.setdefault(finding.view, {})[finding.about] = finding.sentence
    return found


def test_nothing_is_wrong_with_the_cornell_box(tmp_path, capsys):
    main(["check", "--scene", "cornell", "--out", str(tmp_path / "out")])
    assert "Nothing looks wrong." in capsys.readouterr().out
    page = (tmp_path / "out/check.html").read_text()
    assert page.count('class="tile"') == 10
    assert page.index('class="tile"') < page.index("<th>edge rank</th>")  # pictures are seen before numbers
    rows = csv_rows(tmp_path / "out/check.csv")
    assert [row["view"] for row in rows][:2] == ["train_000", "train_001"]
    assert all(float(row["edge_excess"]) < 0.0 and not row["wrong"] for row in rows)
    assert [float(row["exposure"]) for row in rows[:8]] == pytest.approx([1.0] * 8, abs=0.05)
    assert all(row["exposure"] == "" for row in rows[8:])


def test_a_lamp_that_every_photograph_clips_has_words_in_place_of_numbers(tmp_path):
    scene = builtin.build("cornell")
    checked = checked_scene(replace(scene, train=scene.train[:3], test=[]), source)
    (lamp,) = checked.light.lamps
    clipped = replace(lamp, photographed=np.full(3, np.nan), pixels=9)
    write_pages(replace(checked, light=replace(checked.light, lamps=[clipped])), tmp_path)
    page = (tmp_path / "check.html").read_text()
    assert "clipped in every photograph" in page
    assert "nan" not in re.sub('base64,[^"]*', "", page)


def test_a_hole_in_a_scan_is_told():
    """Without a triangle of a wall, of which the photographs show all."""
    scene = builtin.build("cornell")
    meshes = [replace(m, faces=m.faces[1:]) if m.name == "back" else m for m in scene.meshes]
    found = said(checked_scene(replace(scene, meshes=meshes), source))
    assert "the mesh has holes" in found[""]["holes"]


@pytest.mark.parametrize("emitters", ["known", "find"])
def test_a_room_without_light_is_looked_at_all_the_same(emitters, tmp_path):
    """Of a mesh of another unit than the cameras' nothing shines: the unit is named, not the lamps alone."""
    scene = builtin.build("cornell")
    dim = [with_photograph(view, tmp_path, lambda x: np.minimum(x, 0.2)) for view in scene.train[:3]]
    meshes = [replace(m, vertices=300.0 * m.vertices, radiance=None) for m in scene.meshes]
    checked = checked_scene(replace(scene, meshes=meshes, train=dim, test=[]), source, emitters)
    (refused,) = checked.findings.of(Level.REFUSED)
    assert refused.about == "lamp"
    assert "scale the meshes alone by 0.01" in said(checked)[""]["units"]
    assert len(checked.looked) == 3


def test_each_damaged_view_is_named(tmp_path):
    """A turned camera, another frame, a camera in a block; mirrored, foreign and clipped photographs."""
    scene = builtin.build("cornell")
    views = list(scene.train)
    views[0] = posed(views[0], views[0].camera.to_world @ np.diag([1.0, -1.0, -1.0, 1.0]))  # sees a blank wall
    views[1] = turned(views[1], 5.0)
    views[2] = with_photograph(views[2], tmp_path, lambda x: x[:, ::-1])
    views[3] = replace(views[3], image=scene.train[6].image)
    views[4] = with_photograph(views[4], tmp_path, lambda x: np.minimum(x, 0.2))
    views[7] = moved(views[7], INSIDE)
    found = said(checked_scene(replace(scene, train=views, test=[]), source))
    assert "OpenCV" in found["train_000"]["edges"]
    assert found["train_001"].keys() == {"edges"}
    assert "degrees to the right" in found["train_001"]["edges"]
    assert "left and right are exchanged" in found["train_002"]["edges"]
    assert "fits the pose of view train_006" in found["train_003"]["edges"]
    assert found["train_004"].keys() == {"photograph"}
    assert "clipped" in found["train_004"]["photograph"]
    assert "inside of a wall" in found["train_007"]["camera"]
    assert not {"train_005", "train_006"} & found.keys()


def test_frames_of_another_convention_a_camera_outside_and_a_lamp_that_is_missing():
    scene = builtin.build("cornell")
    views = [posed(view, view.camera.to_world @ np.diag([1.0, -1.0, -1.0, 1.0])) for view in scene.train[:5]]
    outside = scene.train[5].camera.to_world
    views.append(moved(scene.train[5], outside[:3, 3] + 2.0 * outside[:3, 2]))
    found = said(checked_scene(replace(scene, train=views, test=[]), source))
    assert "most photographs" in found[""]["edges"]
    assert "outside of the room" in found["train_005"]["camera"]
    scene = builtin.build("patterns")
    meshes = [replace(mesh, radiance=None) if mesh.name == "window" else mesh for mesh in scene.meshes]
    dark = replace(scene, meshes=meshes, train=scene.train[:8], test=[])
    found = said(checked_scene(dark, lambda scene: SceneData(DataSettings(scene="patterns")).over(scene)))
    assert "window (" in found[""]["lamp"]
    assert "has no lamp there" in found[""]["lamp"]


def test_what_a_fit_refuses_is_refused_and_the_others_are_looked_at(tmp_path, monkeypatch, capsys):
    """Photographs with a NaN, of equal pixels, two stops brighter, in a room of 300 units with a lamp ten times as
    bright.
    """
    scene = brighter(builtin.build("cornell"), 10.0)
    meshes = [replace(mesh, vertices=mesh.vertices * np.float32(100.0)) for mesh in scene.meshes]
    views = [moved(view, 100.0 * view.camera.to_world[:3, 3]) for view in scene.train]

    def spoilt(pixels):
        pixels[3, 5] = np.nan
        return pixels

    views[2] = with_photograph(views[2], tmp_path, spoilt)
    views[3] = with_photograph(views[3], tmp_path, lambda x: np.full_like(x, 0.25))
    views[5] = with_photograph(views[5], tmp_path, lambda x: 4.0 * x)
    spoilt_scene = replace(scene, name="spoilt", meshes=meshes, train=views)
    monkeypatch.setitem(builtin._BUILDERS, "spoilt", lambda: spoilt_scene)
    with pytest.raises(SystemExit) as end:
        main(["check", "--scene", "spoilt", "--out", str(tmp_path / "out")])
    told = capsys.readouterr()
    assert end.value.code == 2
    assert "train_002.exr: it has pixels that are NaN or infinite (1 of 4096)" in told.err
    assert told.err.count("\n") == 1
    assert "scale meshes and cameras by 0.01" in told.out
    assert "view train_003: all pixels of its photograph are equal" in told.out
    assert "view train_005: its photograph is" in told.out
    assert "times brighter than the lights make it, against all others" in told.out
    assert "the photographs are" in told.out
    assert "times darker than the scene" in told.out
    assert "NaN" in (tmp_path / "out/check.html").read_text()


def test_photographs_of_unlike_exposures_are_right_where_a_fit_recovers_these(tmp_path):
    """Half of them two stops brighter, their mean as it was; one that shows something else is named all the same."""
    scene = builtin.build("cornell")
    gains = [2.0 if k % 2 else 0.5 for k in range(len(scene.train))]
    views = [with_photograph(v, tmp_path, lambda x, g=g: g * x) for v, g in zip(scene.train, gains, strict=True)]
    unlike = replace(scene, train=views, test=[])
    assert any("exposure" in text for text in said(checked_scene(unlike, source))[""].values())
    fitted = Photography(exposure="fit")
    checked = checked_scene(replace(unlike, photography=fitted), source)
    assert checked.findings.worst == Level.NOTE
    assert list(checked.light.exposures.values()) == pytest.approx([1.0] * len(views), rel=0.1)
    views[2] = with_photograph(views[2], tmp_path, lambda x: x[:, ::-1])
    found = said(checked_scene(replace(unlike, train=views, photography=fitted), source))
    assert "left and right are exchanged" in found["train_002"]["edges"]


def test_a_table_that_is_there_stays(tmp_path, capfd, monkeypatch):
    monkeypatch.chdir(tmp_path)  # a folder check/ may lie where a user has run it
    (tmp_path / "check.csv").write_text("mine")
    assert "is there already" in fails(capfd, "check", "--scene", "cornell", "--out", str(tmp_path))
    assert (tmp_path / "check.csv").read_text() == "mine"


def test_a_lamp_that_faces_away_is_named_and_those_that_a_fit_recovers_are_not_compared():
    scene = builtin.build_cornell()
    turned_over = [m if m.radiance is None else replace(m, faces=m.faces[:, ::-1].copy()) for m in scene.meshes]
    away = replace(scene, meshes=turned_over)
    wrong = " ".join(finding.text for finding in checked_scene(away, source).findings.of(Level.WRONG))
    assert "faces away from the room" in wrong
    assert "mean albedo" not in wrong

    dim = brighter(builtin.build_cornell(), 0.2)  # no photograph shows the lamp
    (wrong,) = (finding.text for finding in checked_scene(dim, source).findings.of(Level.WRONG))
    assert "lights of the scene that are too dim" in wrong
    assert checked_scene(dim, source, "fit").findings.worst == Level.NOTE


# ---- measures of a check against closed forms: free space, seen area, exposure, clipped pixels


def standing(place, fov=1.2):
    pose = np.eye(4, dtype=np.float32)
    pose[:3, 3] = place
    return Camera(pose, fov, 16, 16)


def test_directions_come_in_pairs_and_cover_the_sphere():
    d = both_ways(256)
    torch.testing.assert_close(d[:256], -d[256:])
    torch.testing.assert_close(d.norm(dim=-1), torch.ones(512))
    torch.testing.assert_close(d.T @ d / 512, torch.eye(3) / 3, atol=5e-3, rtol=0)


def test_free_space_in_a_slab_and_beside_it():
    """Between parallel planes at a distance of 1 the way through is 1 / cos, the median of which is 2."""
    side = 400.0
    floor = quad((-side / 2, 0.0, -side / 2), (0, 0, side), (side, 0, 0))
    ceiling = quad((-side / 2, 1.0, -side / 2), (side, 0, 0), (0, 0, side))
    meshes = [solid.mesh(name, 0, smooth_shading=False) for name, solid in (("floor", floor), ("ceiling", ceiling))]
    world = build_world(Scene("slab", [meshes[0], replace(meshes[1], radiance=np.ones(3, np.float32))],
                              [diffuse("paint", 0.5)]))  # fmt: skip
    inside, above = surroundings(world, [standing((0.0, 0.3, 0.0)), standing((0.0, 1.5, 0.0))])
    assert inside.free < 0.02
    assert inside.width == pytest.approx(2.0, rel=0.02)
    assert inside.backs == 0.0  # both face each other
    assert above.free == pytest.approx(0.5, abs=0.02)
    assert above.open_half == pytest.approx(1.0, abs=0.03)
    assert math.isinf(above.width)
    assert above.backs == 1.0


def test_a_camera_before_an_open_wall_is_not_outside():
    scene = builtin.build("cornell")
    meshes = [mesh for mesh in scene.meshes if mesh.name != "back"]
    (_, _, low), (_, _, high) = scene.bounds
    world = build_world(replace(scene, meshes=meshes))
    before, beyond = surroundings(world, [standing((0.0, 0.0, low + x * (high - low))) for x in (0.1, -0.1)])
    assert before.free > 0.35
    assert before.open_half < FAR_OUT
    assert beyond.open_half > FAR_OUT


def test_seen_area_is_what_is_in_sight():
    """A camera above the middle of a floor sees a square of it; the side away from it counts as the same surface."""
    floor = quad((-1.0, 0.0, -1.0), (0, 0, 2), (2, 0, 0)).mesh("floor", 0, smooth_shading=False)
    lamp = quad((5.0, 5.0, 5.0), (1, 0, 0), (0, 0, 1)).mesh(
        "lamp", 0, smooth_shading=False, radiance=np.ones(3, np.float32)
    )
    world = build_world(Scene("floor", [floor, lamp], [diffuse("paint", 0.5)]))
    down = standing((0.0, 1.0, 0.0), 2.0 * math.atan(0.5))
    down.to_world[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    points, seen = seen_points(world.geometry, SeenBy(world.geometry, world.tracer, [down]), 1)
    assert points.sum() == POINTS
    assert points[0] / POINTS == pytest.approx(0.8, abs=0.02)  # areas 4 and 1
    assert seen[0] / points[0] == pytest.approx(0.25, abs=0.02)
    assert seen[1] == 0


def test_exposure_is_the_ratio_of_means_without_fireflies():
    rng = np.random.default_rng(2)
    view = torch.arange(1200) // 600
    expected = torch.from_numpy(rng.gamma(4.0, 0.25, (1200, 3))).float()
    shown = expected * torch.from_numpy(rng.gamma(50.0, 0.02, (1200, 1))).float() * torch.tensor([3.0, 0.5])[view, None]
    expected[5] = 1e4
    shown[600::20] = 40.0  # a mirror, of which the scene knows nothing, shows a lamp
    ratios = exposure_ratios(shown, expected, view, 3)
    np.testing.assert_allclose(ratios[:2], [3.0, 0.5], rtol=0.05)
    assert np.isnan(ratios[2])


def test_clipped_black_and_equal_pixels():
    pixels = np.random.default_rng(3).random((80, 80, 3), np.float32)
    inside = np.ones((80, 80), bool)
    inside[:10] = False
    pixels[:10] = 7.0  # a lamp
    plain = photograph_facts(pixels, inside)
    assert plain.clipped < 0.001
    assert plain.highest == 7.0
    assert plain.levels > 256
    assert not plain.constant
    clipped = photograph_facts(np.minimum(pixels, 0.75), inside)
    assert clipped.clipped == pytest.approx(0.25, abs=0.02)
    dark = pixels.copy()
    dark[40:47] = 0.0
    assert photograph_facts(dark, inside).black == pytest.approx(0.1)
    assert photograph_facts(np.full_like(pixels, 0.5), inside).constant
    assert photograph_facts(np.round(pixels * 255) / 255, inside).levels <= 257
    small, everywhere = 0.1 + 0.8 * pixels[:12, 20:36] / 7.0, np.ones((12, 16), bool)
    assert photograph_facts(small + 1e-3 * pixels[10:22, :16], everywhere).clipped == 0.0  # one brightest of 192 pixels
    small[:2, 0] = 1.0
    assert photograph_facts(small, everywhere).clipped == pytest.approx(2 / 192)


def test_rendered_pixels_are_those_of_the_photographs():
    """The Cornell box's photographs against its own materials: the mean over some pixels agrees to a few per cent."""
    from datamodules.scene_data import SceneData
    from datamodules.settings import DataSettings

    scene = build("cornell")
    world = build_world(scene)
    sample = few(SceneData(DataSettings(scene="cornell")).dataset_stats().sample, len(scene.train))
    kept = slice(None, None, 8)
    pixels = replace(sample, view=sample.view[kept], pixel=sample.pixel[kept], color=sample.color[kept])
    found = rendered(world, TrueMaterials(scene, world.geometry), [v.camera for v in scene.train], pixels, 4)
    assert float(found.mean() / pixels.color.mean()) == pytest.approx(1.0, abs=0.08)
