"""``neurad fit --data.hints``: what is said of places holds in the fit and for whoever reads the run."""

from pathlib import Path

import torch
import yaml
from helpers.lamp_room import DOWNWARDS, lamp_room, photographed
from helpers.tiny_fit import checkpoint, config, fails, few_views, fit, run_folder, write_tiny_config

import neurad
from neurad.lamps.find import find_lamps
from neurad.metrics.held_out import HeldOut


def hints_of(run):
    """Hints of all kinds about a run's room; and the view and the pixel of a place that they leave out."""
    places, views = {}, run.scene.train  # a point of each group of a kind, and the pixel that shows it
    group = run.materials.recovered["roughness"].parts
    for index, view in enumerate(views):
        si = run.surface(view)
        emits = (run.world.geometry.emission[si.prim.clamp_min(0)] > 0).any(-1)
        for part in torch.unique(group.of(si.prim)[si.valid & ~emits]).tolist():
            shown = (si.valid & (group.of(si.prim) == part)).nonzero().squeeze(-1)
            lane = int(shown[len(shown) // 2])
            places.setdefault(part, ([round(float(x), 6) for x in si.p[lane]], index, lane))
    lamp = next(mesh for mesh in run.scene.meshes if mesh.radiance is not None)
    first, second, third, fourth = list(places.values())[:4]
    return [
        {"shines": [float(x) for x in lamp.vertices[lamp.faces[0]].mean(0)]},
        {"one_material": [first[0], second[0]]},
        {"one_material": [fourth[0], second[0]]},
        {"leave_out": third[0]},
        {"leave_out": {"view": views[0].name, "rectangle": [0, 0, 20, 10]}},
        {"leave_out": {"view": run.scene.test[0].name, "rectangle": [5, 6, 9, 9]}},
    ], third[1:]


def test_the_run_keeps_the_hints(place, monkeypatch):
    """In the room with two lamps; their file is gone."""
    few_views(monkeypatch, "patterns", 4)
    write_tiny_config(base="patterns.yaml", trainer={"max_steps": 3}, model={"roughness": {"structure": "auto"}})
    fit("--trainer.max_steps=1")
    plain = neurad.load(run_folder())
    entries, (index, lane) = hints_of(plain)
    Path("hints.yaml").write_text(yaml.safe_dump(entries))
    fit("--data.hints=hints.yaml")
    Path("hints.yaml").unlink()
    assert config(1)["data"]["hints"] == entries
    assert config(1)["model"]["lighting"]["emitters"] == "find"
    run = neurad.load(run_folder(1))
    scene = run.scene

    # this shines: that lamp, and those of the scene's file
    found = {scene.meshes[lamp["mesh"]].name for lamp in checkpoint(1)["neurad"]["shining"]}
    assert found >= {mesh.name for mesh in plain.scene.meshes if mesh.radiance is not None}
    assert run.assembly.lamps is not None

    # this is one material: two groups fewer, as all three places are in one
    group, before = run.materials.recovered["roughness"].parts, plain.materials.recovered["roughness"].parts
    places = torch.tensor([*entries[1]["one_material"], entries[2]["one_material"][0]])
    assert len(group.at(places).unique()) == 1
    assert len(before.at(places).unique()) == 3
    assert group.count == before.count - 2

    # leave this out: pixels that see it, and rectangles, train nothing and score nothing
    assert scene.train[0].left_out[:10, :20].all()
    assert scene.test[0].left_out[6:9, 5:9].all()
    held_out = HeldOut(scene, run.world.geometry, run.world.tracer)
    assert not held_out.kept(0)[6:9, 5:9].any()
    assert scene.train[index].left_out.ravel()[lane]


def test_pixels_that_are_left_out_train_nothing(tiny, monkeypatch):
    """Whatever photographs show there, the fit is the same to the last bit."""
    from neurad.images import photographs
    from neurad.scene import builtin

    names = [view.name for view in builtin.build("cornell").train]
    Path("hints.yaml").write_text("".join(f"- leave_out: {{view: {n}, rectangle: [0, 0, 40, 30]}}\n" for n in names))
    write_tiny_config(data={"patches": 64, "hints": "hints.yaml"}, trainer={"max_steps": 4})
    read = photographs.read_photograph

    def spoilt(*args):
        pixels = read(*args).copy()
        pixels[:30, :40] *= 3.0
        return pixels

    fit()
    monkeypatch.setattr(photographs, "read_photograph", spoilt)
    fit()
    write_tiny_config(data={"patches": 64}, trainer={"max_steps": 4})
    fit("--model.lighting.lamp_mismatch=warn")
    first, second, third = (
        torch.cat([v.flatten() for k, v in sorted(checkpoint(i)["state_dict"].items()) if k.startswith("materials.")])
        for i in range(3)
    )
    assert torch.equal(first, second)
    assert not torch.equal(first, third)


def test_bad_hints_are_refused_before_anything(tiny, capfd):
    for name, text, said in (
        ("hints", "- shines: [0, 0, 0]\n- leave_out: [1, 2]\n",
         "--data.hints hints.yaml: entry 2: leave_out is [1, 2], but three numbers"),
        ("none", "", "there is no such file of hints"),
        ("hints", "- one_material: [[0, 0, 0], [1, 0, 0]]\n- leave_out: [100, 2, 3]\n",
         "entry 2: leave_out: 100, 2, 3: no surface is there"),
    ):  # fmt: skip
        Path("hints.yaml").write_text(text)
        words = "fit", "--config", "tiny.yaml", "--data.hints", f"{name}.yaml", "--trainer.max_steps=1"
        assert said in fails(capfd, *words)


def test_groups_that_a_fit_does_not_make_are_said(tiny, capfd):
    write_tiny_config(trainer={"max_steps": 1}, model={"roughness": {"structure": "free"}})
    Path("hints.yaml").write_text("- one_material: [[-1, 0, 0], [0, -1, 0]]\n")
    fit("--data.hints=hints.yaml", "--model.lighting.lamp_mismatch=warn")
    assert "neurad: warning: one_material of the hints changes nothing here" in capfd.readouterr().err


def test_lamps_of_the_scene_stay_lamps_where_no_photograph_shows_them():
    scene = lamp_room(cameras=DOWNWARDS)
    found = find_lamps(scene, photographed(scene, 4), "embree", False, 1, declared=True)
    names = [scene.meshes[lamp.mesh].name for lamp in found.lamps]
    assert sorted(names) == sorted(mesh.name for mesh in scene.meshes if mesh.radiance is not None)
    for name in names:
        assert f"{name} shines: as the scene's file says" in found.lines
    assert not any("some lamp is in no photograph" in line for line in found.lines)
