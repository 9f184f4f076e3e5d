"""How long the viewer takes, at 512 x 512 pixels: `pytest -s -m slow tests/inspect/test_viewer_speed.py`.

Bounds are for a quiet machine with two cores. ``NEURAD_VIEW_RUN`` names a run folder to measure instead of a short fit.
"""

import os
import time
from dataclasses import replace

import numpy as np
import pytest
from helpers.tiny_fit import fit, run_folder, write_tiny_config

import neurad
from neurad.inspect.lamps import LightSettings, as_photographed, lamp_renderer, lamps_of
from neurad.inspect.maps import RENDER, PhotographMap, SeenMap, modes_of
from neurad.inspect.pose import pose_of
from neurad.inspect.refine import Refiner, Request, ViewedRun, warm_up
from neurad.inspect.still import Look
from neurad.integrators.film import render
from neurad.integrators.renderer import MethodRenderer
from neurad.metrics.seen import SeenBy
from neurad.pages.colours import encode
from neurad.runtime.threads import torch_on_one
from neurad.scene.exposure import scene_exposure

SIDE, SPP = 512, 256


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    given = os.environ.get("NEURAD_VIEW_RUN")
    if given:
        run = neurad.load(given)
    else:
        folder = tmp_path_factory.mktemp("speed")
        with pytest.MonkeyPatch.context() as patch:
            patch.chdir(folder)
            write_tiny_config(base="patterns.yaml", data={"patches": 128}, trainer={"max_steps": 600})
            fit()
            run = neurad.load(folder / run_folder())
    cameras = [view.camera for view in run.scene.train]
    seen = SeenMap(run.world, SeenBy(run.world.geometry, run.world.tracer, cameras))
    modes = modes_of(run, seen, PhotographMap(run.world, run.views))
    room = ViewedRun(run, lamps_of(run.assembly), modes, seen)
    with torch_on_one():
        warm_up(room, run.scene.test[0].camera)
        yield room


@pytest.fixture
def camera(room):
    return replace(room.run.scene.test[0].camera, width=SIDE, height=SIDE)


@pytest.fixture
def factor(room):
    """Exposure that the page shows the run with."""
    return scene_exposure(room.run.scene)


def psnr(shown, reference):
    return 10 * np.log10(255**2 / np.mean((shown.astype(float) - reference.astype(float)) ** 2))


def until(room, camera, light, factor, reference, decibels, limit):
    """Seconds to the first picture and to one that is this near to the reference, both as a screen shows them."""
    refiner, look = Refiner(room), Look(light, factor)
    request = Request(pose_of(camera), RENDER, look, SIDE * SIDE)
    start, first = time.perf_counter(), None
    while True:
        frame = refiner.work(request, lambda: False)
        seconds = time.perf_counter() - start
        if frame is not None:
            if first is None:
                first = seconds, frame.picture.shape[:2]
            if not frame.coarse and psnr(frame.picture, reference) >= decibels:
                return first, seconds, frame.says
        assert seconds < limit, (first, None if frame is None else psnr(frame.picture, reference))


@pytest.mark.slow
@pytest.mark.parametrize("off", [False, True])
def test_first_picture_and_thirty_decibels(room, camera, factor, off):
    """Of the photographs' light; and with the brightest lamp off, against as many samples of those that are left."""
    left = [lamp_renderer(room.run.assembly, lamp) for lamp in room.lamps[1:]]
    if off and not left:
        pytest.skip("the room has one lamp only")
    if off:
        shown = sum(render(camera, lamp, SPP // 4, 8).numpy() for lamp in left)
        light = LightSettings((0.0,) + (1.0,) * (len(room.lamps) - 1))
    else:
        whole = MethodRenderer(room.run.settings.method, room.run.assembly.estimator)
        shown, light = render(camera, whole, SPP, 7).numpy(), as_photographed(room.lamps)
    first, seconds, says = until(room, camera, light, factor, encode(shown * factor), 30.0, 300)
    print(f"\nlamp off: {off}, first picture {first[1]} after {first[0]:.3f} s, 30 dB after {seconds:.2f} s ({says})")
    assert first[0] < (1.0 if off else 0.5)


@pytest.mark.slow
@pytest.mark.parametrize("mode", [RENDER, "albedo", "photograph", "seen"])
def test_pictures_while_moving(room, camera, factor, mode):
    refiner = Refiner(room)
    pose = pose_of(camera)
    x, y, z = pose.position
    sizes, start, spent = [], time.perf_counter(), time.process_time()
    for step in range(40):
        moved = replace(pose, position=(x + 0.002 * step, y, z))
        frame = refiner.work(
            Request(moved, mode, Look(as_photographed(room.lamps), factor), SIDE * SIDE), lambda: False
        )
        sizes.append(frame.picture.shape[0] if frame else 0)
    seconds = (time.perf_counter() - start) / len(sizes)
    spent = (time.process_time() - spent) / len(sizes)
    full = time.perf_counter()
    refiner.room.cost.update({mode: 1e-9})
    refiner.coarse(Request(pose, mode, Look(as_photographed(room.lamps), factor), SIDE * SIDE))
    full = time.perf_counter() - full
    print(
        f"\n{mode} moving: {1 / seconds:.1f} a second of {np.median(sizes):.0f} rows and {spent:.3f} s of processor "
        f"time, whole ones {1 / full:.1f}"
    )
    assert 1 / seconds > 5
