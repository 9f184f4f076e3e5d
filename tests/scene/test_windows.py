"""A room with a window, photographed with an alpha of 1 everywhere: the sky stays in pictures, scores and exports."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from helpers.object_scene import sky
from helpers.pathtraced import paths
from helpers.small_fit import SMALL_FIT
from helpers.tables import csv_rows

from neurad import load
from neurad.cli import main
from neurad.images.image_io import read_exr, write_exr
from neurad.integrators.film import render
from neurad.scene import builtin
from neurad.scene.builtin.plain import diffuse, room, views
from neurad.scene.description import Scene

SIZE = 20
EYES = [((-0.8, 0.3, -0.8), (0.4, 0, 1)), ((0.8, 0.5, -0.7), (-0.4, -0.2, 1)), ((0.1, -0.4, -0.9), (0, 0.1, 1))]


def windowed():
    """A white room whose front is open, and cameras that look out of it."""
    solids = {name: solid for name, solid in room((-1, -1, -1), (1, 1, 1)).items() if name != "front"}
    paints = [diffuse("white", 0.7), diffuse("red", (0.6, 0.2, 0.1))]
    meshes = [solid.mesh(name, int(name == "left"), smooth_shading=False) for name, solid in solids.items()]
    return Scene(
        "window", meshes, paints, environment=sky(4, 8), train=views("train", EYES, 70.0, SIZE),
        test=views("test", [((0.5, -0.2, -0.9), (-0.1, 0.1, 1)), ((-0.5, 0.2, -0.8), (0.6, 0, 1))], 70.0, SIZE),
    )  # fmt: skip


def photographed(scene, folder, alpha):
    """The scene with photographs whose alpha is ``alpha``."""
    tracer = paths(scene)

    def photograph(view):
        picture = render(view.camera, tracer, 64, 3).numpy()
        write_exr(folder / f"{view.name}.exr", np.concatenate((picture, np.full_like(picture[..., :1], alpha)), -1))
        return replace(view, image=str(folder / f"{view.name}.exr"))

    train, test = ([photograph(view) for view in part] for part in (scene.train, scene.test))
    return replace(scene, train=train, test=test)


def fit_it(monkeypatch, scene, steps, **data):
    """A fit of the scene as ``small``."""
    monkeypatch.setitem(builtin._BUILDERS, "small", lambda: scene)
    config = {**SMALL_FIT, "data": {**SMALL_FIT["data"], **data}}
    config["trainer"] = {**SMALL_FIT["trainer"], "max_steps": steps, "max_time": None}
    Path("fit.yaml").write_text(yaml.safe_dump(config))
    main(["fit", "--config", "fit.yaml"])


@pytest.mark.parametrize("resident", [None, 2])
def test_a_window_keeps_its_sky(place, monkeypatch, capfd, resident):
    """Alpha of half floats that renderers round from 1. All pixels are met as well as those of surfaces, and better, as
    the sky is known; exported and rendered again, it is there.
    """
    scene = photographed(windowed(), place, 0.9995)
    fit_it(monkeypatch, scene, 40, patches=64, resident=resident)
    assert "alpha" not in capfd.readouterr().err
    scores = csv_rows("lightning_logs/version_0/metrics.csv")[-1]
    assert float(scores["psnr_linear"]) > float(scores["psnr_linear_seen"]) - 0.5
    run = load("lightning_logs/version_0")
    assert not run.assembly.world.hide_environment
    if resident is None:
        main(["export", "--ckpt_path", "lightning_logs/version_0", "--out", "out", "--size", "32", "--no-verify"])
        main(["render", "--root", "out", "--out", "again", "--views", "test", "--spp", "64", "--map-spp", "4"])
        for view in scene.test:
            again, before = (read_exr(path)[..., :3] for path in (f"again/images/{view.name}.exr", view.image))
            outside = read_exr(f"again/albedo/{view.name}.exr").max(-1) == 0.0
            assert outside.mean() > 0.1
            np.testing.assert_allclose(again[outside].mean(0), before[outside].mean(0), rtol=0.02)


def test_photographs_that_show_their_background_as_clear_hide_it(place, monkeypatch, capfd):
    scene = photographed(windowed(), place, 1.0)
    clear = read_exr(scene.train[1].image)
    clear[0, 0] = 0.0
    write_exr(scene.train[1].image, clear)
    write_exr(scene.train[2].image, read_exr(scene.train[2].image)[..., :3])
    fit_it(monkeypatch, scene, 1, patches=16)
    said = capfd.readouterr().err
    assert said.count("alpha is 1 everywhere in 2 of 3 photographs (train_000, train_002) and below it in others") == 1
    assert load("lightning_logs/version_0").assembly.world.hide_environment
