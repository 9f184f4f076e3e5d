"""``neurad bench ceiling``: how well the material fields could do if the truth itself were photographed."""

from __future__ import annotations

import argparse


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    from neurad.commands.bench.options import add_settings

    add_settings(parser)
    parser.add_argument("--seconds", type=float, default=60.0, help="length of the fit, set-up left out (default: 60)")


def run(options: argparse.Namespace) -> None:
    """Fit the config's albedo and roughness fields to the true maps of the training views; print held-out scores.

    Whatever recovers materials from photographs with the same fields cannot be expected to score higher.

    Raises:
        InputError: the settings are wrong, or the scene has no true maps of its training views.
    """
    from lightning.pytorch.callbacks import Timer

    from neurad.callbacks.table import score_table
    from neurad.commands.bench.session import prepare
    from neurad.commands.bench.supervised import TrueMaps
    from neurad.core.errors import InputError

    if options.seconds <= 0:
        raise InputError(f"--seconds: {options.seconds} is not a positive time")
    trainer, module, data = prepare(options, 10**9)
    trainer.callbacks = [Timer({"seconds": options.seconds}), TrueMaps()]  # type: ignore[attr-defined]
    trainer.fit(module, data)
    scores = {k: v for k, v in module.evaluate(1).scores.items() if not k.startswith("psnr_")}
    print(f"supervised ceiling after {module.iteration} steps in {options.seconds:g} s")
    print(score_table(scores, 1))
