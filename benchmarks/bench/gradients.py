"""``neurad bench gradients``: the paper's bias study, where the answer is known.

On the integrating sphere the derivative of the reflected light by the albedo has a closed form, for path replay of
limited depth, for ``k`` differentiable bounces that end in the radiance field, and for the debiased mode; so each
method's bias is seen without a network's. ``--field_error`` makes the field wrong by a factor.
"""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Annotated

from neurad.core.ranges import OpenFraction, Range, option

if TYPE_CHECKING:
    from neurad.integrators.method import Method
    from neurad.runtime.tables import Record

PRB_BOUNCES = (2, 4, 10, 15, 30)
OURS_BOUNCES = (1, 2, 4)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--albedos", type=option(OpenFraction), nargs="+", default=[0.5, 0.8, 0.95], metavar="A", help="of the sphere"
    )
    parser.add_argument(
        "--paths", type=option(Annotated[int, Range(16, 1 << 31)]), default=48000, help="paths for each figure"
    )
    parser.add_argument(
        "--field_error",
        type=option(Annotated[float, Range(-1.0, above=True)]),
        default=0.0,
        help="0.2 makes the radiance field 20 %% too bright",
    )
    parser.add_argument("--tracer", default="embree", help="embree or open3d")
    parser.add_argument("--out", metavar="FILE.csv", help="write the table here too")


def run(options: argparse.Namespace) -> None:
    """Measure, and print the table.

    Raises:
        InputError: there is no such ray caster.
    """
    from benchmarks.bench.machine import report
    from benchmarks.closed_form import Sphere
    from neurad.integrators.prb import PRB

    rows: list[Record] = []
    for albedo in options.albedos:
        sphere = Sphere(albedo, options.tracer, 1.0 + options.field_error)
        for (name, bounces), method in {**methods(), ("reference", None): PRB(None)}.items():
            fraction, error = sphere.gradient_fraction(method, options.paths)
            truth = sphere.predicted(method)
            rows.append(
                {
                    "method": name, "bounces": bounces, "albedo": albedo, "fraction": fraction, "standard_error": error,
                    "theory": truth, "z": (fraction - truth) / max(error, 1e-6),
                }
            )  # fmt: skip
    report(rows, "Integrating sphere: fraction of the derivative by albedo, and its value in theory", options.out)


def methods() -> dict[tuple[str, int | None], Method]:
    """The methods that are compared, by name and bounces (None: a random number of them)."""
    from neurad.integrators.debiased import Debiased
    from neurad.integrators.prb import PRB
    from neurad.integrators.radiometric import Radiometric

    capped: dict[tuple[str, int | None], Method] = {("direct", 1): PRB(2)}
    capped |= {("prb", n): PRB(n + 1) for n in PRB_BOUNCES}
    capped |= {("ours", k): Radiometric(k) for k in OURS_BOUNCES}
    return {**capped, ("debiased", None): Debiased()}
