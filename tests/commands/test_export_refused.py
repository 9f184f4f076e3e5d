"""What ``neurad export`` refuses, in one sentence and without a folder that is half written."""

import json
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from helpers.exported import Glb
from helpers.small_files import small_files
from helpers.tiny_fit import fails, fit

from neurad.cli import main
from neurad.export import gltf
from neurad.formats.load import load_scene
from neurad.images.image_io import read_exr, write_exr

pytest.importorskip("xatlas")
pytest.importorskip("mitsuba")

EXPORT = ["--out", "out", "--size", "16", "--no-verify"]


def left():
    """What is there besides the run, its scene and its config."""
    return sorted(p.name for p in Path().iterdir() if p.name not in ("lightning_logs", "room", "tiny.yaml"))


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ([*EXPORT, "--texels", "many"], "'many' is not a number of texels, such as 16M"),
        ([*EXPORT, "--texels", "inf"], "'inf' is not a number of texels"),
        ([*EXPORT, "--texels=-1M"], "-1000000 is out of range, it must be at least 4096"),
        ([*EXPORT, "--size", "100"], "100 is no power of two"),
        ([*EXPORT, "--blender", "true"], "it verifies, which --no-verify leaves out"),
        ([*EXPORT[:-1], "--blender", "/bin/true"], "neither a Python with the package bpy nor Blender"),
        ([*EXPORT, "--root", "nowhere"], "its scene nowhere is missing"),
        ([*EXPORT, "--out", "room"], "room is there already; add --overwrite"),
        ([*EXPORT, "--out", "room", "--overwrite"], "is no folder of an earlier export"),
        ([*EXPORT, "--out", "."], "is the folder that you are in"),
        ([*EXPORT, "--out", "..", "--overwrite"], "the folder that you are in, or lies above it"),
        ([*EXPORT, "--out", "x" * 250], "--out"),
        ([*EXPORT, "--out", "no/out"], "there is no folder"),
        ([*EXPORT, "--out", "tiny.yaml"], "is there and no folder"),
        ([*EXPORT, "--ckpt_path", "none"], "there is no such run folder or checkpoint"),
        (["--into", "room.blend"], "--blender: there is no blender on the PATH"),
        (["--into", "tiny.yaml"], "--into tiny.yaml: it is neither a Blender file (.blend) nor binary glTF (.glb)"),
        (["--into", "kitchen.blend"], "kitchen.blend: there is no such Blender file"),
        (["--into", "fake.blend"], "fake.blend: it is no file that Blender has saved"),
        (["--into", "fake.glb"], "it does not begin as a binary glTF file does"),
        (["--into", "room.blend", "--out", "fake.blend"], "fake.blend is there already; name another file by --out"),
        (["--into", "room.blend", "--overwrite"], "are about a folder; --into writes a file that is not there yet"),
        (["--group", "material", "--out", "out"], "--group: it is about textures in a file that --into names"),
        ([], "--out: name the folder to write"),
    ],
)
def test_bad_options(fitted_room, capfd, monkeypatch, words, sentence):
    Path("room.blend").write_bytes(b"BLENDER-v405RENDH")
    for name in ("fake.blend", "fake.glb"):
        Path(name).write_bytes(b"nothing")
    monkeypatch.setenv("PATH", "")
    assert sentence in fails(capfd, "export", *words)
    assert Path("room.blend").read_bytes() == b"BLENDER-v405RENDH"


def test_a_scene_that_is_gone(fitted_room, capfd):
    Path("room").rename("moved")
    assert "its scene room is missing" in fails(capfd, "export", *EXPORT)
    main(["export", *EXPORT, "--root", "moved"])
    assert left() == ["moved", "out"]


def test_the_scene_of_the_run_is_not_replaced(fitted_room, capfd):
    main(["export", *EXPORT, "--copy"])
    fit("--trainer.max_steps=1", "--data.root=out")
    assert "which the run needs; export to another folder" in fails(capfd, "export", *EXPORT, "--overwrite")
    assert Path("out/images").is_dir()


def test_a_full_disk(fitted_room, capfd):
    main(["export", *EXPORT])
    before = Path("out/scene.glb").read_bytes()
    rng = np.random.default_rng(0)
    for photo in Path("room/images").iterdir():  # larger than any file may be
        write_exr(photo, rng.random((8, 8, 3), np.float32))
    with small_files(2000):
        sentence = fails(capfd, "export", *EXPORT, "--overwrite", "--copy", alone=False)
    assert sentence.startswith("neurad: error: --out ")
    assert ".part" not in sentence
    assert Path("out/scene.glb").read_bytes() == before
    assert Glb("out/scene.glb").json["asset"]["version"] == "2.0"


def test_ctrl_c(fitted_room, capfd, monkeypatch):
    def interrupted(*args):
        raise KeyboardInterrupt

    monkeypatch.setattr(gltf, "_add_camera", interrupted)
    with pytest.raises(SystemExit) as stop:
        main(["export", *EXPORT])
    assert stop.value.code == 130
    assert capfd.readouterr().err.strip().endswith("neurad: interrupted")
    assert left() == []


# ---- ``neurad export`` as a user runs it: a folder that others read, that is a scene folder itself, or one sentence


WHOLE_EXPORT = ["export", "--out", "room", "--size", "16", "--spp", "1"]


def test_a_room_is_exported_read_again_fitted_and_rendered(tiny, capfd):
    import trimesh

    fit("--trainer.max_steps", "4", "--data.patches", "1024")
    with suppress(SystemExit):  # one sample a pixel is too noisy for the bounds of the verification
        main(WHOLE_EXPORT)
    room = Path("room")
    described = Glb(room / "scene.glb").json
    assert described["asset"]["extras"]["base_color_for"] == "blender"
    assert described["extensionsUsed"] == ["KHR_materials_emissive_strength", "KHR_materials_specular"]
    loaded = trimesh.load(room / "scene.glb")
    scene, again = load_scene(None, "cornell"), load_scene("room", None)
    assert len(loaded.geometry) == len(scene.meshes) == len(again.meshes)
    assert np.allclose(loaded.bounds, scene.bounds, atol=1e-6)
    for before, after in zip(scene.meshes, again.meshes, strict=True):
        assert np.array_equal(before.vertices[before.faces], after.vertices[after.faces])
        assert (before.radiance is None) == (after.radiance is None)
    assert [v.name for v in again.test] == [v.name for v in scene.test]
    notes = json.loads((room / "room.json").read_text())
    assert {mesh["name"] for mesh in notes["meshes"]} == set(loaded.geometry)
    verified = json.loads((room / "verify.json").read_text())
    assert set(verified["renderers"]) == {"baked", "fields", "mitsuba"}
    assert verified["scores"]["albedo_baked_to_fields_psnr"] > 40
    assert '<figure class="tile">' in (room / "report.html").read_text()
    assert all((room / "evidence" / f"{mesh['name']}.png").is_file() for mesh in notes["meshes"])
    for mesh in notes["meshes"]:
        std, size = read_exr(room / "albedo_std" / f"{mesh['name']}.exr"), mesh["texture"]
        assert std.shape == (max(size["height"] // 4, 4), max(size["width"] // 4, 4), 3)
        assert bool(std.max() > 0) != mesh["emits"]  # what a lamp is made of is known
    assert (room / "images" / f"{again.train[0].name}.exr").is_symlink()

    fit("--data.scene", "null", "--data.root", "room", "--trainer.max_steps", "1")
    main(["render", "--root", "room", "--out", "seen", "--views", "test", "--spp", "1", "--map-spp", "1"])
    assert (Path("seen/images") / f"{again.test[0].name}.exr").is_file()

    assert "is there already; add --overwrite" in fails(capfd, *WHOLE_EXPORT)
    more = ["--overwrite", "--copy", "--no-verify", "--for=gltf", "--ckpt_path=lightning_logs/version_0"]
    main([*WHOLE_EXPORT, *more])
    assert not (room / "verify.json").exists()
    assert not (room / "images" / f"{again.train[0].name}.exr").is_symlink()
    assert Glb(room / "scene.glb").json["asset"]["extras"]["base_color_for"] == "gltf"
    assert sorted(p.name for p in Path().iterdir() if p.name.startswith(".")) == []
