"""``neurad check``: whether a scene folder is sound."""

import argparse
from pathlib import Path

from neurad.runs.trust import add_reader, add_trust


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    parser.add_argument("--root", help="scene folder")
    parser.add_argument("--scene", help="name of a built-in scene instead")
    add_reader(parser)
    add_trust(parser)
    parser.add_argument(
        "--out", type=Path, default=Path("check"), help="folder for check.html and check.csv (default: check)"
    )
    parser.add_argument(
        "--model.lighting.emitters",
        dest="emitters",
        choices=("known", "photographs", "fit", "find"),
        default="known",
        help="what a fit will take as known of lamps, as there (default: known)",
    )
    parser.add_argument(
        "--data.exposure",
        dest="exposure",
        choices=("known", "fit"),
        default="known",
        help="what a fit will take as known of exposures, as there (default: known)",
    )
    parser.add_argument("--overwrite", action="store_true", help="write over a check that is there")


def run(options: argparse.Namespace) -> None:
    """Check it.

    Raises:
        InputError: it cannot be read, or a fit would refuse it.
        SystemExit: with 1 if something is wrong.
    """
    from datamodules.scene_data import SceneData
    from datamodules.settings import DataSettings
    from neurad.inspect.check.run import check
    from neurad.runs.model_settings import own_reader

    reader = own_reader(options.reader, options.trust)
    source = SceneData(DataSettings(options.root, options.scene)).over
    known = options.emitters, options.exposure
    check(options.root, options.scene, reader, source, *known, options.out, options.overwrite)
