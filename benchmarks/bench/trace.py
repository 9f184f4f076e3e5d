"""``neurad bench trace``: rays a second of every tracer that is installed, by kind of ray and size of batch."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from neurad.core.durations import time_option
from neurad.core.ranges import Positive

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from benchmarks.bench.machine import Row
    from neurad.core.records import Rays
    from neurad.scene.description import Scene
    from neurad.scene.geometry import Geometry


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--scene", default=None, help="name of a built-in scene (default patterns)")
    where.add_argument("--root", default=None, metavar="DIR", help="a scene folder")
    parser.add_argument("--tracers", default="embree,open3d,warp", help="names, separated by commas")
    parser.add_argument("--sizes", default="1024,4096,32768,262144", help="rays in a batch, separated by commas")
    parser.add_argument("--device", default="cpu", help="where the rays lie: cpu or cuda")
    parser.add_argument("--seconds", type=time_option(Positive), default=0.5, help="time for each figure")
    parser.add_argument("--out", metavar="FILE.csv", help="write the table here too")


def run(options: argparse.Namespace) -> None:
    """Time all tracers and print the table.

    Raises:
        InputError: no such scene, tracer or device, or a size is not a number.
    """
    from benchmarks.bench.machine import describe, pick_device, report
    from neurad.core.errors import InputError
    from neurad.formats.load import load_scene
    from neurad.scene.geometry import Geometry
    from neurad.tracing.select import TRACERS

    device = pick_device(options.device)
    try:
        sizes = [int(word) for word in options.sizes.split(",")]
    except ValueError:
        raise InputError(f"--sizes {options.sizes}: these are not numbers separated by commas") from None
    names = options.tracers.split(",")
    if unknown := [name for name in names if name not in TRACERS]:
        raise InputError(f"--tracers {unknown[0]}: there is none of that name, choose from {', '.join(TRACERS)}")
    if min(sizes) < 1:
        raise InputError(f"--sizes {options.sizes}: a batch needs a ray")
    scene = load_scene(options.root, None if options.root else options.scene or "patterns")
    geometry = Geometry(scene)
    kinds = ray_kinds(scene, geometry, max(sizes), device)
    rows: list[Row] = []
    for name in names:
        rows += _tracer_rows(name, geometry, kinds, sizes, device, options.seconds)
    if not rows:
        raise InputError(f"--tracers {options.tracers}: none of these is installed")
    report(rows, f"{scene.name}, {len(geometry.faces)} triangles, on {describe(device)}", options.out)


def ray_kinds(
    scene: Scene, geometry: Geometry, count: int, device: torch.device
) -> dict[str, tuple[Rays, Tensor | None]]:
    """Rays of each kind, the last with how far they reach: from cameras, spread over hemispheres, and to other points.

    Args:
        scene: with training views.
        geometry: its triangles.
        count: rays of each kind.
        device: where they shall lie.
    """
    import torch

    from neurad.core.camera import camera_rays
    from neurad.core.frame import dot
    from neurad.core.records import Rays
    from neurad.core.rng import Stream
    from neurad.tracing.select import make_tracer

    stream = Stream(0)
    views = scene.train or scene.test
    each = -(-count // len(views))
    parts = []
    for view in views:
        size = torch.tensor([view.camera.width, view.camera.height])
        parts.append(camera_rays(view.camera, stream.uniform(each, 2) * size))
    camera = Rays.cat(*parts)[torch.randperm(each * len(views), generator=stream.generator)[:count]]
    si = geometry.interact(camera, make_tracer("embree", geometry.vertices, geometry.faces).closest(camera))
    seen = si.valid.nonzero().squeeze(-1)
    si = si[seen[torch.arange(count) % len(seen)]]
    out = torch.nn.functional.normalize(torch.randn(count, 3, generator=stream.generator), dim=-1)
    side = torch.where(dot(si.n, si.wo) < 0, -1.0, 1.0).unsqueeze(-1) * si.n
    away = torch.nn.functional.normalize(side + 0.999 * out, dim=-1)  # cosine-weighted
    bounced = geometry.spawn(si, away)
    other = si.p[torch.randperm(count, generator=stream.generator)] - si.p
    distance = other.norm(dim=-1).clamp_min(1e-6)
    shadow, reach = geometry.spawn_towards(si, other / distance.unsqueeze(-1), distance)
    kinds: dict[str, tuple[Rays, Tensor | None]] = {
        "camera": (camera, None), "bounce": (bounced, None), "shadow": (shadow, reach),
    }  # fmt: skip
    return {k: (rays.to(device), t if t is None else t.to(device)) for k, (rays, t) in kinds.items()}


def _tracer_rows(
    name: str,
    geometry: Geometry,
    kinds: dict[str, tuple[Rays, Tensor | None]],
    sizes: list[int],
    device: torch.device,
    seconds: float,
) -> list[Row]:
    """A row for each kind and size; none, with a line that says why, where the tracer is not installed."""
    import time

    from benchmarks.bench.machine import typical
    from neurad.core.errors import InputError
    from neurad.tracing.select import make_tracer

    begin = time.perf_counter()
    try:
        tracer = make_tracer(name, geometry.vertices, geometry.faces)
    except InputError as error:
        print(f"neurad: left out: {error}")
        return []
    first = kinds["camera"][0][:1]
    tracer.closest(first)
    build = time.perf_counter() - begin
    rows: list[Row] = []
    for kind, (rays, reach) in kinds.items():
        found = []
        for size in sizes:
            part, far = rays[:size], None if reach is None else reach[:size]
            work = (lambda p=part: tracer.closest(p)) if far is None else (lambda p=part, t=far: tracer.occluded(p, t))
            found.append((size, typical(work, device, seconds)))
        best = max(size / t for size, t in found)
        for size, t in found:
            rows.append(
                {
                    "tracer": name, "rays": kind, "batch": size, "ms": 1e3 * t, "mega_per_s": size / t / 1e6,
                    "floor_ms": 1e3 * size / best, "ratio": t * best / size, "build_s": build,
                }
            )  # fmt: skip
    return rows
