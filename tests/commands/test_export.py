"""``neurad export`` as a user runs it: a folder that others read, that is a scene folder itself, or one sentence."""

import json
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from helpers.exported import Glb
from helpers.tiny_fit import fails, fit

from neurad.cli import main
from neurad.formats.load import load_scene
from neurad.images.image_io import read_exr

pytest.importorskip("xatlas")
pytest.importorskip("mitsuba")

EXPORT = ["export", "--out", "room", "--size", "16", "--spp", "1"]


@pytest.mark.main
def test_a_room_is_exported_read_again_fitted_and_rendered(tiny, capfd):
    import trimesh

    fit("--trainer.max_steps", "4", "--data.patches", "1024")
    with suppress(SystemExit):  # one sample a pixel is too noisy for the bounds of the verification
        main(EXPORT)
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

    assert "is there already; add --overwrite" in fails(capfd, *EXPORT)
    main([*EXPORT, "--overwrite", "--copy", "--no-verify", "--for", "gltf", "--ckpt_path", "lightning_logs/version_0"])
    assert not (room / "verify.json").exists()
    assert not (room / "images" / f"{again.train[0].name}.exr").is_symlink()
    assert Glb(room / "scene.glb").json["asset"]["extras"]["base_color_for"] == "gltf"
    assert sorted(p.name for p in Path().iterdir() if p.name.startswith(".")) == []
