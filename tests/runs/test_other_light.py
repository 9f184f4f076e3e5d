"""Runs under other light than that of their fit: what may change, what is said, and what a fit that goes on refuses."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from helpers.spoil import xml
from helpers.tiny_fit import fails, fit, run_folder

import neurad
from neurad.assembly.relight import paths, recovered_scene, relit
from neurad.checkpoints.file import read_checkpoint, write_checkpoint
from neurad.cli import main
from neurad.core.errors import InputError
from neurad.formats.edits.edit import Edit, edited
from neurad.images.image_io import read_exr
from neurad.integrators.film import render
from neurad.integrators.renderer import MethodRenderer
from neurad.runs.load import load_run

pytest.importorskip("mitsuba")

SMALL = ("--spp", "2", "--map-spp", "1")


@pytest.fixture
def fitted(fitted_room):
    """A run of the scene folder ``room``, the same room in other light, and a thing to put in."""
    shutil.copytree("room", "evening")
    xml('name="radiance" value="1, 2, 3"', 'name="radiance" value="2, 2, 3"')(Path("evening"))
    trimesh.creation.box().export("box.glb")
    return fitted_room


def picture(run, parts):
    with torch.no_grad():
        return render(run.scene.test[0].camera, MethodRenderer(paths(run.scene), parts), 4, 1).numpy()


def test_an_edit_that_changes_nothing_renders_the_same_paths(fitted):
    """The same fields, lamps and numbers: an oracle of how the parts are put together again."""
    run = load_run(run_folder())
    again = relit(run.assembly, edited(recovered_scene(run.assembly), Edit()))
    run.world.guide = None
    np.testing.assert_array_equal(picture(run, run.assembly.estimator), picture(run, again))


def test_what_an_edit_says_replaces_what_was_recovered_there_alone(fitted):
    run = load_run(run_folder())
    made = edited(recovered_scene(run.assembly), Edit(materials={"floor": {"albedo": (0.1, 0.2, 0.3)}}))
    parts = relit(run.assembly, made)
    si = run.surface(run.scene.test[0])
    with torch.no_grad():
        before, after = run.materials(si), parts.materials(si)
    floor = torch.from_numpy(np.isin(run.world.geometry.mesh_index[si.prim.clamp_min(0)].numpy(), [0])) & si.valid
    assert floor.any()
    np.testing.assert_allclose(after.albedo[floor].numpy(), np.broadcast_to([0.1, 0.2, 0.3], (int(floor.sum()), 3)))
    np.testing.assert_array_equal(after.roughness[floor].numpy(), before.roughness[floor].numpy())
    rest = ~floor & si.valid
    np.testing.assert_array_equal(after.albedo[rest].numpy(), before.albedo[rest].numpy())
    np.testing.assert_array_equal(parts.materials.albedo(si)[si.valid].numpy(), after.albedo[si.valid].numpy())


def test_light_may_change_for_results_and_not_for_a_fit_that_goes_on(fitted, capfd):
    said = "another light than in the fit: lamp lamp 2, 2, 3 instead of 1, 2, 3"
    main(["test", "--data.root=evening"])
    assert said in capfd.readouterr().err
    assert "psnr_lhs" not in json.loads((run_folder() / "metrics.json").read_text())
    main(["predict", "--data.root=room"])
    assert "another light" not in capfd.readouterr().err
    error = fails(capfd, "fit", "--ckpt_path=last", "--data.root=evening", "--trainer.max_steps=3")
    assert "the light of scene evening is not that of the fit (lamp lamp 2, 2, 3 instead of 1, 2, 3)" in error
    run = neurad.load(run_folder(), "evening")
    assert run.light_changes == ("lamp lamp 2, 2, 3 instead of 1, 2, 3",)
    assert run.radiance is None
    with pytest.raises(InputError, match="the light of scene evening is not that of the fit"):
        load_run(run_folder(), "evening", other_light=False)
    file = Path("evening/scene.xml")
    dark = re.sub(r"<emitter.*</emitter>", "", file.read_text())
    file.write_text(dark.replace("</scene>", '<emitter type="constant"/></scene>'))
    run = neurad.load(run_folder(), "evening")
    assert run.light_changes[0] == "lamp lamp off instead of 1, 2, 3"
    assert run.light_changes[1] == "an environment where there was none"
    assert run.materials.known_meshes == {1}  # the lamp that is off keeps the albedo that is known
    xml('<translate y="2"/>', '<translate y="3"/>')(Path("evening"))
    assert "not of evening as given" in fails(capfd, "test", "--data.root=evening")


@pytest.mark.parametrize("lamps", ["known", "fit"])
def test_a_sky_that_was_recovered_does_not_shine_where_there_is_none(fitted, capfd, lamps):
    """Nor do lamps under a sky; where both are, both are those of the fit."""
    text = Path("room/scene.xml").read_text().replace("</scene>", '<emitter type="constant"/></scene>')
    for folder, lit in (("both", text), ("sky", re.sub('<emitter type="area".*</emitter>', "", text))):
        shutil.copytree("room", folder)
        Path(folder, "scene.xml").write_text(lit)
    mismatch, emitters = "--model.lighting.lamp_mismatch=warn", f"--model.lighting.emitters={lamps}"
    fit("--data.root=both", "--model.lighting.environment=fit", "--trainer.max_steps=2", mismatch, emitters)
    path = str(run_folder(1))
    capfd.readouterr()
    main(["test", f"--ckpt_path={path}", "--data.root=room"])
    assert "another light than in the fit: no environment; pictures are path traced" in capfd.readouterr().err
    found = load_run(path)
    for folder, sky, lamp in (("room", False, True), ("sky", True, False)):
        run = load_run(path, folder)
        assert (run.assembly.environment is not None) == sky
        assert (run.assembly.lamps is not None) == (lamp and lamps == "fit")
        if sky:
            assert torch.equal(run.assembly.environment.values, found.assembly.environment.values)
        if lamp and lamps == "fit":
            assert torch.equal(run.assembly.lamps.values, found.assembly.lamps.values)
        assert run.light_changes == ("no environment" if lamp else "lamp lamp off instead of 1, 2, 3",)


def test_a_checkpoint_that_does_not_keep_what_a_run_does_is_refused(fitted):
    path = run_folder() / "checkpoints" / "last.ckpt"
    content = read_checkpoint(path, "")
    for name in ("geometry", "light"):
        write_checkpoint({**content, "neurad": {k: v for k, v in content["neurad"].items() if k != name}}, path)
        with pytest.raises(InputError, match=rf"neurad\.{name} is missing or wrong"):
            load_run(run_folder())
    write_checkpoint({**content, "neurad": content["neurad"] | {"radiance_inputs": 1.5}}, path)
    with pytest.raises(InputError, match=r"neurad\.radiance_inputs is missing or wrong"):
        load_run(run_folder())
    none = {"lamps": [], "environment": None, "punctual": []}
    for light in ({}, none | {"lamps": [[0]]}, none | {"environment": {"pixels": 1}}, none | {"punctual": [1]}):
        write_checkpoint({**content, "neurad": {**content["neurad"], "light": light}}, path)
        with pytest.raises(InputError, match="light is none that a run writes"):
            load_run(run_folder())


def test_render_a_run_with_free_cameras_and_edits(fitted, capfd):
    pose = json.loads(Path("room/transforms_test.json").read_text())["frames"][0]["transform_matrix"]
    frames = [{"transform_matrix": pose}, {"transform_matrix": pose, "w": 6, "h": 4}]
    Path("cameras.json").write_text(json.dumps({"camera_angle_x": 0.9, "frames": frames}))
    Path("evening.yaml").write_text("lamps: {lamp: 0.5}\nobjects: [{file: box.glb, at: 0, size: 0.5}]\n")
    options = ["--ckpt_path", str(run_folder()), "--camera", "cameras.json", "--edit", "evening.yaml", *SMALL]
    main(["render", *options, "--out", "out"])
    said = capfd.readouterr()
    assert "neurad: changed: lamp lamp 0.5, 1, 1.5 instead of 1, 2, 3" in said.err
    assert said.out.endswith("neurad: pictures are in out/images (EXR), as PNG in out/png\n")
    assert [read_exr(f"out/images/{name}.exr").shape for name in ("0000", "0001")] == [(8, 8, 3), (4, 6, 3)]
    assert sorted(p.name for p in Path("out/png").iterdir()) == ["0000.png", "0001.png"]
    assert len(json.loads(Path("out/transforms.json").read_text())["frames"]) == 2
    assert "out/images/0000.exr is there already; add --overwrite" in fails(capfd, "render", *options, "--out", "out")
    # the run as it is: its own method and radiance field, so the field's own picture comes, too
    main(["render", "--ckpt_path", str(run_folder()), *SMALL, "--out", "own"])
    assert Path("own/images_lhs/test_0.exr").exists()
    assert not list(Path().glob("own/transforms.json"))
    # neural radiosity: the field is learned for the new light
    main(["render", *options, "--out", "field", "--integrator", "radiometric", "--steps", "3"])
    assert "its radiance field is learned anew" in capfd.readouterr().err
    assert Path("field/images_lhs/0000.exr").exists()
    # another folder of the same geometry
    main(["render", "--ckpt_path", str(run_folder()), "--root", "evening", *SMALL, "--out", "other"])
    assert "changed: lamp lamp 2, 2, 3 instead of 1, 2, 3" in capfd.readouterr().err


@pytest.mark.parametrize("kind", ["turntable", "pan", "fly"])
def test_films_of_moving_cameras(fitted, kind):
    options = ["--ckpt_path", str(run_folder()), "--path", kind, "--frames", "3", "--spp", "1", "--size", "7"]
    main(["render", *options, "--views", "all", "--movie", "png", "--out", "film"])
    assert sorted(p.name for p in Path("film/frames").iterdir()) == ["0000.png", "0001.png", "0002.png"]
    if kind == "turntable":
        ffmpeg = pytest.importorskip("imageio_ffmpeg")
        main(["render", *options, "--out", "film"])
        count, seconds = ffmpeg.count_frames_and_secs("film/path.mp4")
        assert count == 3
        assert seconds == pytest.approx(0.1, abs=0.05)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--edit", "nowhere.yaml"], "nowhere.yaml: there is no such file"),
        (["--edit", "lamp.yaml"], "--edit lamp.yaml: lamps: there is no lamp lmap; did you mean lamp?"),
        (["--edit", "mesh.yaml"], "materials: there is no mesh flor; did you mean floor?"),
        (["--edit", "thing.yaml"], "nothing.glb: there is no such object"),
        (["--camera", "nowhere.json"], "nowhere.json: there is no such file"),
        (["--camera", "lamp.yaml"], "lamp.yaml: it is not valid JSON"),
        (["--camera", "bad.json"], "bad.json: frame 0: its transform_matrix is not rigid"),
        (["--camera", "bad.json", "--views", "test"], "--views: the cameras are those of --camera"),
        (["--root", "nowhere"], "its scene nowhere is missing"),
        (["--ckpt_path", "nowhere"], "run nowhere: there is no such run folder or checkpoint"),
        (["--scene", "cornell"], "--scene: a run has its own scene"),
        (["--path", "spin"], "invalid choice: 'spin'"),
        (["--frames", "0"], "0 is out of range"),
        (["--out", "lamp.yaml"], "--out lamp.yaml: it is a file, but a folder is needed"),
    ],
)
def test_what_is_wrong_gets_one_sentence(fitted, capfd, words, sentence):
    Path("lamp.yaml").write_text("lamps: {lmap: off}\n")
    Path("mesh.yaml").write_text("materials: {flor: {albedo: 0.5}}\n")
    Path("thing.yaml").write_text("objects: [{file: nothing.glb, at: 0}]\n")
    frame = {"transform_matrix": [[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}
    Path("bad.json").write_text(json.dumps({"camera_angle_x": 0.9, "frames": [frame]}))
    error = fails(capfd, "render", "--ckpt_path", str(run_folder()), "--out", "out", *SMALL, *words)
    assert sentence in error


def test_a_missing_package_is_named_before_work(fitted, capfd, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "imageio_ffmpeg", None)
    error = fails(capfd, "render", "--ckpt_path", str(run_folder()), "--out", "out", "--path", "pan")
    assert "--movie png writes pictures" in error
    assert "pip install 'neurad[video]'" in error


def test_a_lamp_that_is_far_off_is_refused_before_training(fitted, capfd):
    shutil.rmtree("lightning_logs")
    # the cameras look at it; photographs are noise around 0.5
    xml('<rotate x="1" angle="90"/><translate y="2"/>', '<translate y="1"/>')(
        Path("room")
    )  # the cameras look at it; photographs are noise around 0.5
    words = "fit", "--config", "tiny.yaml", "--data.root=room", "--trainer.max_steps=1"
    error = fails(capfd, *words, alone=False)
    assert re.search(r"scene room: lamp lamp is .* times darker in blue in the photographs than the declared", error)
    assert "--model.lighting.lamp_mismatch warn" in error
    fit("--data.root=room", "--trainer.max_steps=1", "--model.lighting.lamp_mismatch=warn")
    said = capfd.readouterr().err
    assert "neurad: lamp lamp: photographed over declared radiance 0." in said
    assert "warning: lamp lamp is" in said
