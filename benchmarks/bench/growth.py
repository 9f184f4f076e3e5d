"""``neurad bench growth``: how set-up, step and memory grow with triangles, views, resolution and table size."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from neurad.core.ranges import Count, Positive, option

if TYPE_CHECKING:
    from torch import Tensor

    from neurad.core.scene_records import Mesh
    from neurad.runtime.tables import Record
    from neurad.scene.description import Scene

CURVES = {
    "triangles": "1000,10000,100000,1000000,5000000",
    "views": "16,64,1000",
    "streamed": "16,64,256,1000",
    "resolution": "64,128,256,512",
    "table": "13,15,17,19,21,23",
}
"""What grows, and its default values: triangles, training views all in memory, training views streamed from disk, their
side in pixels, log2 of a level's entries."""


COLUMNS = (
    "grows", "value", "triangles", "views", "in_memory", "pixels", "entries", "setup_s", "ms_per_step", "mean_ms",
    "cpu_ms", "needs_MiB", "peak_MiB",
)  # fmt: skip
"""Columns: ``in_memory`` counts photographs, ``ms_per_step`` is the median, ``mean_ms`` includes what only some
steps do (wait for a photograph), ``cpu_ms`` is the mean of the process's own time, ``needs_MiB`` an estimate of the
part that grows and ``peak_MiB`` measured, of the process."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    from benchmarks.bench.options import add_settings, add_timing

    add_settings(parser, "cornell.yaml")
    for name, values in CURVES.items():
        parser.add_argument(f"--{name}", default=values, help=f"values, separated by commas; '' for none ({values})")
    parser.add_argument(
        "--side", type=option(Count), help="pixels along a side of a view (512 where views grow, else 128)"
    )
    parser.add_argument(
        "--resident", type=option(Count), default=8, help="photographs in memory where they are streamed"
    )
    add_timing(parser, steps=30, warmup=10)
    parser.add_argument(
        "--memory", type=option(Positive), default=8.0, help="GiB; points that need more are not measured"
    )


def run(options: argparse.Namespace) -> None:
    """Measure each point in a separate process and print the table.

    Raises:
        InputError: a value is not a number, or the settings are wrong.
    """
    import multiprocessing

    from benchmarks.bench.machine import describe, pick_device, report

    device = pick_device(options.device)
    points = [(curve, value) for curve in CURVES for value in _values(curve, getattr(options, curve))]
    rows: list[Record] = []
    for curve, value in points:
        need = expected_bytes(curve, value, side_of(options, curve), options.resident)
        if need > options.memory * 2**30:
            print(f"neurad: left out: {curve} {value} needs about {need / 2**30:.1f} GiB (--memory {options.memory:g})")
            rows.append({**dict.fromkeys(COLUMNS), "grows": curve, "value": value, "needs_MiB": need / 2**20})
            continue
        with multiprocessing.get_context("spawn").Pool(1) as pool:  # peak memory is that of a process
            rows.append(pool.apply(measure, (options, curve, value)))
        print(f"neurad: {curve} {value} measured", flush=True)
    report(rows, f"growth on {describe(device)}, {' '.join(options.config or [options.default_config])}", options.out)


def _values(curve: str, text: str) -> list[int]:
    from neurad.core.errors import InputError

    try:
        values = [int(word) for word in text.split(",") if word]
    except ValueError:
        raise InputError(f"--{curve} {text}: these are not numbers separated by commas") from None
    if any(value < 1 for value in values):
        raise InputError(f"--{curve} {text}: every value must be at least 1")
    return values


def side_of(options: argparse.Namespace, curve: str) -> int:
    """Pixels along a side of the views of a curve."""
    side: int = options.side or (512 if curve in ("views", "streamed") else 128)
    return side


def expected_bytes(curve: str, value: int, side: int, resident: int) -> float:
    """Rough memory of a point: photographs and cached camera rays (eight positions per pixel), triangles or tables.

    Every pixel, streamed or not, has a byte for the emitter mask.
    """
    pixel = 12.0 + 12.0 * 8
    if curve == "views":
        return (pixel + 1.0) * value * side * side
    if curve == "streamed":
        return (value + 12.0 * min(value, resident)) * side * side
    if curve == "resolution":
        return pixel * 8 * value * value
    return 600.0 * value if curve == "triangles" else 3 * 8 * 2.0**value * 24


def measure(options: argparse.Namespace, curve: str, value: int) -> Record:
    """One point: a short fit of the enlarged scene."""
    import tempfile
    from statistics import mean, median

    import torch

    from benchmarks.bench.measure import Stopwatch, fit
    from benchmarks.bench.session import prepare

    settings = list(options.set)
    if curve == "table":
        fields = ("albedo", "roughness", "radiance")
        settings += [f"model.{name}.grid.{key}" for name in fields for key in (f"log2_size={value}", "finest=2048")]
    if curve == "streamed":
        settings += ["model.sampling.cached_spp=0", f"data.resident={options.resident}"]
    options = argparse.Namespace(**{**vars(options), "set": settings})
    trainer, module, data = prepare(options, options.warmup + options.steps)
    side = side_of(options, curve)
    scene = grown(data.scene, curve, value, side)
    camera = scene.train[0].camera
    watch = Stopwatch(options.steps, options.warmup)
    pixels: Tensor | None = None
    with tempfile.TemporaryDirectory() as folder:
        if curve in ("views", "streamed"):
            scene = photographed(scene, folder)
        else:
            pixels = torch.empty(len(scene.train), camera.width * camera.height, 3)
            pixels.uniform_(0.1, 1.0, generator=torch.Generator().manual_seed(0))  # the cost does not depend on them
        fit(trainer, module, data.over(scene, pixels), watch)
    world, count = module.assembly.world, len(scene.train)
    return {
        "grows": curve, "value": value, "triangles": len(world.geometry.faces), "views": count,
        "in_memory": min(count, data.resident or count), "pixels": camera.width * camera.height,
        "entries": sum(p.numel() for p in module.parameters()), "setup_s": watch.setup_seconds,
        "ms_per_step": 1e3 * median(watch.plain), "mean_ms": 1e3 * mean(watch.plain),
        "cpu_ms": 1e3 * mean(watch.processor),
        "needs_MiB": expected_bytes(curve, value, side, options.resident) / 2**20, "peak_MiB": watch.peak / 2**20,
    }  # fmt: skip


def grown(scene: Scene, curve: str, value: int, side: int) -> Scene:
    """The scene with ``value`` triangles on its floor, as many training views, or views of that side."""
    from dataclasses import replace

    from neurad.core.scene_records import View

    size = value if curve == "resolution" else side
    count = value if curve in ("views", "streamed") else len(scene.train)

    def view(index: int, base: View) -> View:
        return View(f"{base.name}_{index}", replace(base.camera, width=size, height=size))

    train = [view(i, scene.train[i % len(scene.train)]) for i in range(count)]
    meshes = [*scene.meshes, bumps(scene, value)] if curve == "triangles" else scene.meshes
    return replace(scene, meshes=meshes, train=train, test=[view(0, scene.test[0])])


def photographed(scene: Scene, folder: str, contents: int = 8) -> Scene:
    """The scene with a file of noise for each training view: ``contents`` different ones, and hard links to them."""
    from dataclasses import replace
    from pathlib import Path

    import numpy as np

    from neurad.images.image_io import write_exr

    train = []
    for index, view in enumerate(scene.train):
        path = Path(folder) / f"{index:05d}.exr"
        if index < contents:
            shape = (view.camera.height, view.camera.width, 3)
            write_exr(path, np.random.default_rng(index).uniform(0.1, 1.0, shape).astype(np.float32))
        else:
            path.hardlink_to(Path(folder) / f"{index % contents:05d}.exr")
        train.append(replace(view, image=str(path)))
    return replace(scene, train=train)


def bumps(scene: Scene, triangles: int) -> Mesh:
    """A bumpy sheet of about ``triangles`` triangles in the lower part of the scene."""
    import numpy as np

    from neurad.core.scene_records import Mesh

    side = max(1, round((triangles / 2) ** 0.5))
    low, high = (np.asarray(corner, dtype=np.float64) for corner in scene.bounds)
    x, z = np.meshgrid(np.linspace(0.1, 0.9, side + 1), np.linspace(0.1, 0.9, side + 1))
    y = 0.15 + 0.03 * np.sin(40.0 * x) * np.sin(37.0 * z) + 0.1 / side * np.random.default_rng(0).random(x.shape)
    vertices = low + (high - low) * np.stack((x, y, z), -1).reshape(-1, 3)
    corner = (np.arange(side)[:, None] * (side + 1) + np.arange(side)).ravel()
    a, b, c, d = corner, corner + 1, corner + side + 1, corner + side + 2
    faces = np.concatenate((np.stack((a, c, b), -1), np.stack((b, c, d), -1)))
    return Mesh("bumps", vertices.astype(np.float32), faces.astype(np.int64), 0)
