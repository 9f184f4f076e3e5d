"""``neurad data blender`` on files that Blender has made, beside pictures that Cycles has rendered of them."""

import json
import subprocess
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from helpers.clients import blender_python, cache_folder
from helpers.pathtraced import picture
from helpers.tables import csv_rows
from scipy.ndimage import binary_erosion

from neurad.cli import main
from neurad.formats.load import read_folder
from neurad.images.image_io import read_exr, read_mask, to_srgb

pytest.importorskip("mitsuba")
pytestmark = pytest.mark.slow
ROOM = Path(__file__).parent.parent / "helpers/blender_room.py"
ODD = """
import sys, bpy
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.mesh.primitive_plane_add(size=9.0)
paint = bpy.data.materials.new("paint")
bpy.ops.object.text_add(location=(0, 0, 1))
bpy.context.object.data.extrude = 0.1
bpy.context.object.data.materials.append(paint)
bpy.ops.curve.primitive_bezier_circle_add(location=(2, 0, 1))
bpy.context.object.data.bevel_depth = 0.1
bpy.ops.object.metaball_add(location=(-2, 0, 1))
bpy.ops.object.metaball_add(location=(-2.5, 0, 1))
bpy.ops.surface.primitive_nurbs_surface_sphere_add(location=(0, 3, 1))
bpy.ops.object.light_add(location=(0, 0, 3))
bpy.ops.object.camera_add(location=(0, 0, 6))
bpy.ops.wm.save_as_mainfile(filepath=sys.argv[-1])
"""


@pytest.fixture(scope="module")
def python(request):
    """A Python that has bpy."""
    return blender_python(cache_folder(request, "blender"))


def photographed(python, folder, **job):
    """A Blender file of the room, its photographs, and the scene folder that is made of both."""
    (folder / "job.json").write_text(json.dumps({
        "blend": str(folder / "zimmer.blend"), "pictures": str(folder / "fotos"), "threads": 1, **job,
    }))  # fmt: skip
    subprocess.run([python, str(ROOM), str(folder / "job.json")], check=True, capture_output=True)
    words = ["--images", str(folder / "fotos"), "--blender", python, "--out", str(folder / "room")]
    main(["data", "blender", str(folder / "zimmer.blend"), *words])
    return folder / "room"


def test_what_becomes_a_mesh_is_there_once(python, tmp_path):
    """Blender hands out texts, curves, metaballs and surfaces twice: as themselves and as the meshes they become."""
    subprocess.run([python, "-c", ODD, str(tmp_path / "odd.blend")], check=True, capture_output=True)
    main(["data", "blender", str(tmp_path / "odd.blend"), "--blender", python, "--out", str(tmp_path / "room")])
    meshes = sorted(path.stem for path in (tmp_path / "room/meshes").iterdir())
    assert meshes == ["B_zierCircle", "Mball", "Plane", "SurfSphere", "Text"]
    assert "material-paint" in (tmp_path / "room/scene.xml").read_text()


def test_an_open_room_looks_as_in_cycles(python, tmp_path, capsys):
    """Lambertian, so that both have the same surfaces: lamps of all kinds, sky, cameras, modifiers, instances, and a
    pane that Light Path takes out of the way of light.
    """
    room = photographed(python, tmp_path, open=True, views=4, size=[48, 36], samples=192)
    assert "material pane differs by Light Path: it is taken as a camera sees it" in capsys.readouterr().err
    scene = read_folder(room, hold_out=0).check()
    assert scene.features.is_diffuse
    assert [light.kind for light in scene.punctual] == ["directional", "spot", "point"]
    assert len(scene.train) == 4
    for view in scene.train:
        ours = picture(scene, view.camera, 192, 1)
        theirs = read_exr(view.image)[..., :3]
        kept = read_mask(view) if view.mask else np.ones(ours.shape[:2], bool)
        assert kept.mean() > 0.8
        assert ours[kept].mean(0) == pytest.approx(theirs[kept].mean(0), rel=0.02)
        blocks = [np.where(kept[..., None], x, 0.0).reshape(6, 6, 6, 8, 3).sum((1, 3)) for x in (ours, theirs)]
        assert np.abs(blocks[0] - blocks[1]).mean() < 0.03 * blocks[1].mean()


def test_a_room_is_fitted_from_photographs_of_cycles(python, tmp_path, monkeypatch, capfd):
    """Held-out photographs are met to 30 dB with 256 samples a pixel, and Blender's base colours are found, by the
    diffuse lobe that Cycles has.
    """
    room = photographed(python, tmp_path, views=12, size=[80, 60], samples=256)
    monkeypatch.chdir(tmp_path)
    capfd.readouterr()
    main(["check", "--root", str(room), "--out", "check"])  # ends with 1 if something is wrong
    assert "Nothing looks wrong" in capfd.readouterr().out
    main(["render", "--root", str(room), "--out", "blenders", "--views", "test", "--spp", "1", "--map-spp", "16"])
    main([
        "fit", "--config", "scene.yaml", "--data.root", str(room), "--trainer.max_time", "null",
        "--trainer.max_steps", "400", "--trainer.accelerator", "cpu", "--trainer.enable_progress_bar", "false",
        "--evaluation.every_n_steps", "400", "--model.diffuse_lobe", "lambert",
    ])  # fmt: skip
    main([
        "render", "--ckpt_path", "lightning_logs/version_0", "--integrator", "path", "--views", "test", "--spp", "256",
        "--map-spp", "16", "--out", "found",
    ])  # fmt: skip
    views = read_folder(room).test
    assert [view.name for view in views] == ["Camera", "Camera_008"]
    errors, ratios = [], []
    for view in views:
        kept = read_mask(view)
        pictures = [read_exr(path)[..., :3] for path in (Path(f"found/images/{view.name}.exr"), Path(view.image))]
        shown = [to_srgb(np.clip(picture, 0.0, 1.0)) for picture in pictures]
        errors.append(((shown[0] - shown[1])[kept] ** 2).mean())
        base, found = (read_exr(f"{made}/albedo/{view.name}.exr")[..., :3] for made in ("blenders", "found"))
        surface = kept & (base.min(-1) > 0.05)  # lamps are black
        ratios.append((found / np.maximum(base, 0.05))[surface])
    psnr = -10 * np.log10(np.mean(errors))
    middle = np.median(np.concatenate(ratios), axis=0)
    with capfd.disabled():
        print(f"\nheld out {psnr:.2f} dB, found / base {middle.round(3)}")
    assert psnr > 30.0
    assert np.abs(middle - 1.0).max() < 0.04


def test_the_sky_of_an_open_room_stays(python, tmp_path, monkeypatch, capfd):
    """Files of several layers, RGBA with an alpha of 1: all pixels are met as well as those of surfaces, and the sky is
    there when the room is exported and rendered again.
    """
    room = photographed(python, tmp_path, open=True, views=10, size=[64, 48], samples=256, passes=True)
    monkeypatch.chdir(tmp_path)
    assert len(OpenEXR.File(str(next((tmp_path / "fotos").glob("*.exr")))).channels()) > 2
    main([
        "fit", "--config", "scene.yaml", "--data.root", str(room), "--trainer.max_time", "null",
        "--trainer.max_steps", "300", "--trainer.accelerator", "cpu", "--trainer.enable_progress_bar", "false",
        "--evaluation.every_n_steps", "300",
    ])  # fmt: skip
    assert "alpha" not in capfd.readouterr().err
    scores = csv_rows("lightning_logs/version_0/metrics.csv")[-1]
    all_pixels, seen = (
        float(scores[key]) for key in ("psnr_srgb", "psnr_srgb_seen")
    )  # a lamp's edge is all of a linear one
    with capfd.disabled():
        print(f"\nall pixels {all_pixels:.2f} dB, surfaces that photographs show {seen:.2f} dB")
    assert all_pixels > seen - 0.5
    main(["export", "--ckpt_path", "lightning_logs/version_0", "--out", "out", "--size", "128", "--no-verify"])
    main(["render", "--root", "out", "--out", "again", "--views", "test", "--spp", "16", "--map-spp", "4"])
    shown = []
    for view in read_folder(Path("out")).test:
        again, before = (read_exr(path)[..., :3] for path in (f"again/images/{view.name}.exr", view.image))
        sky = read_exr(f"again/albedo/{view.name}.exr").max(-1) == 0.0
        if view.mask is not None:
            sky &= read_mask(view)
        shown.append(sky.mean())
        sky = binary_erosion(sky)  # Blender's filter mixes neighbours
        np.testing.assert_allclose(again[sky].mean(0), before[sky].mean(0), rtol=0.02)
    assert min(shown) > 0.02
    assert max(shown) > 0.05
