"""A flash beside the parts of neurad that look at a scene's light: edits, the viewer's lamps, what a checkpoint keeps,
what compares views with each other; and fits."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.flash_room import flash, flash_room, lit_by, write_folder
from helpers.tables import csv_rows
from helpers.tiny_fit import config, fit, metrics, run_folder, write_tiny_config

from neurad.assembly.build import assemble, build_world
from neurad.assembly.gains import shared_gains
from neurad.assembly.relight import relit
from neurad.cli import main
from neurad.core.camera import camera_rays
from neurad.core.errors import InputError
from neurad.core.records import PixelBatch
from neurad.core.scene_records import PunctualLight
from neurad.formats.edits.edit import Edit, LampEdit, edited, lamps_of
from neurad.inspect.lamps import lamp_renderer
from neurad.inspect.lamps import lamps_of as lamps_in_view
from neurad.integrators.film import render
from neurad.integrators.primary_hits import PrimaryHits
from neurad.integrators.renderer import path_tracer
from neurad.runs.load import load_run
from neurad.runs.model_settings import model_settings
from neurad.scene.light import light_changes, light_of


@pytest.fixture(scope="module")
def room():
    return flash_room(flash(), lamp=True, views=2, size=8)


def known(scene):
    return assemble(scene, replace(model_settings("scene.yaml", 1), materials="known"))


def test_a_room_without_a_flash_carries_none():
    scene = lit_by(flash_room(flash(), lamp=True, views=1))
    world, camera = build_world(scene), scene.train[0].camera
    rays = camera_rays(camera, torch.full((4, 2), 30.0))
    assert (world.flash, rays.flash, world.intersect(rays).flash) == (None, None, None)
    assert not [name for name in world.state_dict() if "flash" in name]


def test_an_edit_scales_it(room):
    assert lamps_of(room) == ["light", "flash"]
    made = edited(room, Edit(lamps={"flash": LampEdit(scale=0.5)}))
    assert made.said == ("lamp flash 1.5, 1.4, 1.3 instead of 3, 2.8, 2.6",)
    for view in (*made.scene.train, *made.scene.test):
        np.testing.assert_allclose(view.camera.flash.intensity, 0.5 * room.flash.intensity)
    off = edited(room, Edit(lamps={"flash": LampEdit(off=True)})).scene
    assert not off.features.has_flash
    with pytest.raises(InputError, match="the flash moves with the camera and has no radiance; give a scale"):
        edited(room, Edit(lamps={"flash": LampEdit(move=(1.0, 0.0, 0.0))}))
    with pytest.raises(InputError, match="leaves no light"):
        edited(flash_room(flash(), views=2, size=8), Edit(lamps={"flash": LampEdit(off=True)}))


def test_a_power_that_was_found_is_kept_by_an_edit(room):
    assembly = known(room)
    with torch.no_grad():
        assembly.world.flash.gain += 0.5
    world = relit(assembly, edited(room, Edit())).world
    assert float(world.flash.gain.mean()) == 0.5


def test_pictures_of_each_lamp_add_up(room):
    assembly, camera = known(room), room.test[0].camera
    lamps = lamps_in_view(assembly)
    assert [(lamp.name, lamp.is_flash, lamp.is_environment) for lamp in lamps] == [
        ("light", False, False), ("flash", True, False)
    ]  # fmt: skip
    whole = render(camera, path_tracer(assembly.world, assembly.materials, 5, 100), 256, 1)
    parts = [render(camera, lamp_renderer(assembly, lamp), 256, 2 + i) for i, lamp in enumerate(lamps)]
    assert float(min(part.mean() for part in parts)) > 0.02
    np.testing.assert_allclose(sum(part.mean() for part in parts), whole.mean(), rtol=0.05)


def test_a_checkpoint_knows_it(room):
    kept = light_of(room)
    assert light_changes(kept, room) == []
    assert light_changes(kept, flash_room(flash((6.0, 2.8, 2.6)), lamp=True, views=2, size=8)) == [
        "light flash 6, 2.8, 2.6 instead of 3, 2.8, 2.6"
    ]
    assert light_changes(kept, lit_by(room)) == ["light flash off instead of 3, 2.8, 2.6"]
    assert light_of(lit_by(room))["punctual"] == []


def test_views_are_not_compared_with_each_other(room):
    """One surface has another light in each."""
    assembly = known(room)
    primary = PrimaryHits(assembly.world, [view.camera for view in room.train], 1, 1, torch.device("cpu"))
    batch = PixelBatch(torch.zeros(1).long(), torch.zeros(1).long(), torch.ones(1, 3), torch.ones(1), 0)
    assert not shared_gains(primary, None, batch, torch.zeros(2, 64).bool(), 1).any()


def test_a_fit_recovers_its_power_and_is_read_again(tmp_path, monkeypatch, capsys):
    """A few steps: what is written, and what becomes of a run whose folder has lost its flash."""
    pytest.importorskip("mitsuba")
    monkeypatch.chdir(tmp_path)
    scene = flash_room(flash(), lamp=True, views=3, size=8)
    write_folder(scene, tmp_path / "room", 4)
    write_folder(lit_by(scene), tmp_path / "still", 1)
    write_tiny_config(base="scene.yaml", data={"root": "room"})
    fit("--trainer.max_steps=30", "--model.lighting.flash=fit", "--model.optimization.light=0.02")
    assert config()["model"]["lighting"]["flash"] == "fit"
    (row,) = csv_rows(run_folder() / "lamps.csv")
    assert (row["mesh"], row["views"], row["scale"]) == ("flash", "3", "weak")
    assert float(row["r"]) != 3.0
    run = load_run(str(run_folder()))
    assert run.radiance.reads_flash
    np.testing.assert_allclose(3.0 * float(run.world.flash.factor().detach()[0]), float(row["r"]), rtol=1e-5)
    assert run.render(run.scene.test[0], 4).mean() > 0
    moved = load_run(str(run_folder()), root=str(tmp_path / "still"))
    assert moved.light_changes == ("light flash off instead of 3, 2.8, 2.6",)
    main(
        ["render", "--ckpt_path", str(run_folder()), "--root", "still", "--spp", "2", "--map-spp", "1", "--out", "lit"]
    )
    assert len(list((tmp_path / "lit" / "images").iterdir())) == 4


@pytest.mark.slow
def test_albedo_is_found_as_under_light_that_stands(tmp_path, monkeypatch):
    """Of photographs lit by a flash alone: as well as of the same room under one lamp, and far better than by a fit
    that takes the flash for a lamp in the middle of its places."""
    pytest.importorskip("mitsuba")
    monkeypatch.chdir(tmp_path)
    scene = flash_room(flash())
    middle = np.mean([view.camera.to_world[:3, 3] for view in scene.train], 0).astype(np.float32)
    told = lit_by(scene, PunctualLight("middle", "point", scene.flash.intensity, middle))
    static = lit_by(scene, PunctualLight("lamp", "point", scene.flash.intensity, np.float32([0.0, 0.8, 0.1])))
    rooms = {"flash": (scene, None), "told": (told, scene), "static": (static, None)}
    found = {}
    for index, (name, (described, photographed)) in enumerate(rooms.items()):
        write_folder(described, tmp_path / name, 64, photographed)
        main(["fit", "--config", "scene.yaml", "--data.root", name, "--trainer.max_steps=400",
              "--trainer.max_time=null", "--evaluation.every_n_steps=100000"])  # fmt: skip
        found[name] = float(metrics(index)[-1]["albedo_psnr"])
    print(found)
    assert found["flash"] > found["told"] + 10.0
    assert found["flash"] > found["static"] - 2.0
