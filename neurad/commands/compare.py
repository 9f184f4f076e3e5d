"""``neurad compare``: several methods on one scene with one budget, and a report of error against cost."""

import argparse
from pathlib import Path

from neurad.core.durations import seconds_of
from neurad.core.ranges import Count, CountOrZero, Positive, option
from neurad.runs.trust import add_trust

EPILOG = """Settings of `neurad fit` such as --data.root DIR are passed on to every fit.

  neurad compare --config kitchen.yaml --methods ours,no_prior,direct,path,prb --budget 120
  neurad compare ours=lightning_logs/version_3 prb=lightning_logs/version_4 --out report
  neurad compare lightning_logs/version_3 --run FIPT=results/fipt --out report
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = EPILOG
    parser.usage = (
        "neurad compare --config NAME.yaml --methods A,B,... (--budget SECONDS | --samples N) [--KEY VALUE ...]\n"
        "       neurad compare [NAME=]RUN ... [--run NAME=DIR ...]"
    )
    parser.set_defaults(settings=())
    parser.add_argument("runs", nargs="*", metavar="[NAME=]RUN", help="finished runs, or the folder of a report")
    parser.add_argument(
        "--run",
        action="append",
        default=[],
        metavar="NAME=DIR",
        help="what another program found: maps of held-out views (DIR/albedo/VIEW.exr, likewise roughness and render), "
        "a curve (DIR/metrics.csv, seconds and scores by the names of a run's), or both; may be repeated",
    )
    parser.add_argument("--config", "-c", action="append", default=[], help="config of the scene; may be repeated")
    parser.add_argument("--methods", help="names of overlays in configs/methods, or YAML files, separated by commas")
    add_trust(parser)
    parser.add_argument(
        "--budget",
        type=option(Positive, seconds_of),
        metavar="TIME",
        help="training time of every fit, such as 120s or 10m, evaluations not counted",
    )
    parser.add_argument("--samples", type=option(Positive), help="path samples of every fit instead")
    parser.add_argument(
        "--plain",
        action="store_true",
        help="methods by gradient descent alone: without the stages of a fit that all of them share otherwise (where "
        "roughness begins, diffuse lobe, metals, roughness refinement, filter of levels)",
    )
    parser.add_argument("--seeds", default="0", help="seeds separated by commas; several give bands (default: 0)")
    parser.add_argument("--out", type=Path, default=Path("report"), help="folder of the report (default: report)")
    parser.add_argument("--overwrite", action="store_true", help="write over a report that is there")
    parser.add_argument(
        "--views", type=option(CountOrZero), default=3, help="held-out views to show, 0 for none (default: 3)"
    )
    parser.add_argument(
        "--view-spp", type=option(Count), default=16, help="samples per pixel of the renders shown (default: 16)"
    )
    parser.add_argument(
        "--reach", default="20,22,24,26,28,30", help="albedo PSNRs in dB whose time is reported (default: %(default)s)"
    )
    parser.add_argument("--resolve", help=argparse.SUPPRESS)  # in a child process: print the configs of these fits


def run(options: argparse.Namespace) -> None:
    """Run what is to be compared, one fit after the other, and write the report.

    Raises:
        InputError: the user's mistake, before anything is written.
        SystemExit: with 1 if a fit failed; the report then has the others.
    """
    if options.resolve is not None:
        from neurad.compare.run import print_configs

        print_configs(options.resolve)
        return
    from neurad.compare.run import compare

    compare(options)
