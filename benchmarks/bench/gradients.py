"""``neurad bench gradients``: the paper's bias study.

The derivative of every pixel by a uniform change of roughness or of albedo, and the derivative of the loss by
roughness, for path replay of limited depth, for ``k`` differentiable bounces that end in the radiance field, and
for the debiased mode; all against path replay of unlimited depth. All surfaces have Burley's reflection, one roughness
and the scene's own albedo. The field is not a network but a new path from every point at which it is queried, exact
in the mean: the measured bias is the method's own. The noise of such a field is far above a network's, most of all in
the debiased mode. ``--field_error`` makes the field wrong by a factor.

On the integrating sphere the derivatives are compared with their closed form.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from neurad.core.ranges import Count, CountOrZero, OpenFraction, Range, option

if TYPE_CHECKING:
    from benchmarks.bench.bias import Gradients, Study
    from neurad.core.records import FloatArray
    from neurad.integrators.method import Method

PRB_BOUNCES = (2, 4, 10, 15, 30)
OURS_BOUNCES = (1, 2, 4)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--scene", default=None, help="name of a built-in scene (default cornell)")
    where.add_argument("--root", default=None, metavar="DIR", help="a scene folder")
    parser.add_argument("--view", type=option(CountOrZero), default=0, help="index of the held-out view")
    parser.add_argument(
        "--size", type=option(Annotated[int, Range(2, 1 << 14)]), default=32, help="width of the pictures in pixels"
    )
    parser.add_argument("--spp", type=option(Count), default=8, help="paths per pixel in a batch")
    parser.add_argument(
        "--batches",
        type=option(Annotated[int, Range(3, 1 << 16)]),
        default=16,
        help="independent estimates; errors come from their spread",
    )
    parser.add_argument(
        "--reference", type=option(Count), default=4, help="batches of the reference for each batch of a method"
    )
    parser.add_argument(
        "--states", type=option(Annotated[float, Range(0.02, 1.0)]), nargs="+", default=[0.2, 0.5, 0.8], metavar="R",
        help="roughnesses, each as a state and as a target of the loss; pictures show the middle one",
    )  # fmt: skip
    parser.add_argument(
        "--albedos",
        type=option(OpenFraction),
        nargs="*",
        default=[0.5, 0.8, 0.95],
        metavar="A",
        help="of the integrating sphere",
    )
    parser.add_argument(
        "--paths",
        type=option(Annotated[int, Range(16, 1 << 31)]),
        default=48000,
        help="paths for each figure on the sphere",
    )
    parser.add_argument(
        "--field_error",
        type=option(Annotated[float, Range(-1.0, above=True)]),
        default=0.0,
        help="0.2 makes the radiance field 20 %% too bright",
    )
    parser.add_argument("--tracer", default="embree", help="embree or open3d")
    parser.add_argument("--out", type=Path, default=Path("gradients"), help="folder to write (default: gradients)")


def run(options: argparse.Namespace) -> None:
    """Measure, print both tables, write ``closed_form.csv``, ``gradients.csv`` and ``gradients.png``.

    Raises:
        InputError: a bad option, or a scene that cannot be used.
    """
    _check(options)
    from benchmarks.bench.machine import report
    from neurad.runtime.files import make_folder

    factor = 1.0 + options.field_error
    study, scene = _study(options, factor)
    make_folder(options.out, "--out")
    rows = _sphere_rows(options, factor)
    if rows:
        title = "Integrating sphere: fraction of the derivative by albedo, and its value in theory"
        report(rows, title, str(options.out / "closed_form.csv"))
    found, reference = _estimate(study, options)
    middle = options.states[len(options.states) // 2]
    targets = {state: study.picture(state, options.spp * options.batches) for state in options.states}
    away = max(options.states, key=lambda state: abs(state - middle))
    table = _bias_rows({key: states[middle] for key, states in found.items()}, reference[middle], middle, away, targets)
    title = (
        f"\n{scene}, roughness {middle:g}, {study.camera.width} x {study.camera.height} pixels, {options.batches} x "
        f"{options.spp} paths per pixel: bias relative to path replay of unlimited depth "
        f"({options.reference} x as many paths)"
    )
    report(table, title, str(options.out / "gradients.csv"))
    from benchmarks.bench.gradient_page import write_page

    page = options.out / "gradients.png"
    write_page(page, found, reference, targets, middle, study.camera, scene)
    print(f"neurad: {page}")


def _check(options: argparse.Namespace) -> None:
    from neurad.core.errors import InputError

    if len(set(options.states)) < len(options.states):
        raise InputError("--states: roughnesses must differ")


def methods() -> dict[tuple[str, int | None], Method]:
    """The methods that are compared, by name and bounces (None: a random number of them)."""
    from neurad.integrators.debiased import Debiased
    from neurad.integrators.prb import PRB
    from neurad.integrators.radiometric import Radiometric

    capped: dict[tuple[str, int | None], Method] = {("direct", 1): PRB(2)}
    capped |= {("prb", n): PRB(n + 1) for n in PRB_BOUNCES}
    capped |= {("ours", k): Radiometric(k) for k in OURS_BOUNCES}
    return {**capped, ("debiased", None): Debiased()}


def _sphere_rows(options: argparse.Namespace, factor: float) -> list[dict[str, Any]]:
    from benchmarks.bench.closed_form import Sphere
    from neurad.integrators.prb import PRB

    rows = []
    for albedo in options.albedos:
        sphere = Sphere(albedo, options.tracer, factor)
        for (name, bounces), method in {**methods(), ("reference", None): PRB(None)}.items():
            fraction, error = sphere.gradient_fraction(method, options.paths)
            truth = sphere.predicted(method)
            rows.append(
                {
                    "method": name, "bounces": bounces, "albedo": albedo, "fraction": fraction, "standard_error": error,
                    "theory": truth, "z": (fraction - truth) / max(error, 1e-6),
                }
            )  # fmt: skip
    return rows


def _study(options: argparse.Namespace, factor: float) -> tuple[Study, str]:
    """The view, in the scene with the principled BSDF in place of every diffuse one."""
    from dataclasses import replace

    from benchmarks.bench.bias import Study
    from benchmarks.bench.per_path import build_path_world
    from neurad.core.camera import resized
    from neurad.core.errors import InputError
    from neurad.core.reflection import PrincipledModel
    from neurad.formats.load import load_scene
    from neurad.scene.textures import TrueMaterials

    scene = load_scene(options.root, None if options.root else options.scene or "cornell")
    rough = [replace(m, model=PrincipledModel()) if m.model.is_diffuse else m for m in scene.materials]
    scene = replace(scene, materials=rough)
    views = scene.test or scene.train
    if options.view >= len(views):
        raise InputError(f"--view: scene {scene.name} has {len(views)} held-out views, and they count from 0")
    world = build_path_world(scene, options.tracer)
    camera = resized(views[options.view].camera, options.size)
    return Study(world, TrueMaterials(scene, world.geometry), camera, options.spp, factor), scene.name


Found = dict[tuple[str, int | None], "dict[float, Gradients]"]


def _estimate(study: Study, options: argparse.Namespace) -> tuple[Found, dict[float, Gradients]]:
    """Gradients of every method and of the reference at every state."""
    import sys

    from neurad.integrators.prb import PRB

    many = options.batches * options.reference
    reference = {state: study.gradients(PRB(None), state, many) for state in options.states}
    found: Found = {}
    for key, method in methods().items():
        found[key] = {state: study.gradients(method, state, options.batches) for state in options.states}
        seconds = found[key][options.states[0]].seconds
        print(f"neurad: {key[0]} {key[1] or ''}: {seconds:.1f} s a state", file=sys.stderr, flush=True)
    return found, reference


def _bias_rows(
    found: dict[tuple[str, int | None], Gradients],
    reference: Gradients,
    state: float,
    away: float,
    targets: dict[float, FloatArray],
) -> list[dict[str, Any]]:
    """A row for each method and quantity. The losses are against the picture of roughness ``away`` and against the
    state's own picture, where the derivative is 0; both in units of the former. The reference's rows hold its errors.
    """
    from benchmarks.bench import bias

    unit = abs(bias.loss_gradient(reference.image, reference.roughness, targets[away]))
    rows: list[dict[str, Any]] = []
    for (name, bounces), own in {**found, ("reference", None): reference}.items():
        for quantity, grad, truth in (
            ("image by roughness", own.roughness, reference.roughness),
            ("image by albedo", own.albedo, reference.albedo),
        ):
            mean, error = bias.image_bias(grad, truth)
            if own is reference:
                mean, error = 0.0, bias.noise(grad, truth)
            rows.append(_bias_row(name, bounces, quantity, mean, error, own.seconds))
            rows[-1] |= {"pixel_rms": bias.pixel_bias(grad, truth), "noise": bias.noise(grad, truth)}
        for quantity, target in ((f"loss, target {away:g}", away), (f"loss, target {state:g}", state)):
            if target != away or away != state:
                against = None if own is reference else reference
                mean, error = bias.loss_bias(own, against, targets[target], unit)
                mean = 0.0 if own is reference else mean
                rows.append(_bias_row(name, bounces, quantity, mean, error, own.seconds))
    return rows


def _bias_row(
    name: str, bounces: int | None, quantity: str, mean: float, error: float, seconds: float
) -> dict[str, Any]:
    return {
        "method": name, "bounces": bounces, "quantity": quantity, "relative_bias": mean, "standard_error": error,
        "pixel_rms": None, "noise": None, "seconds": seconds,
    }  # fmt: skip
