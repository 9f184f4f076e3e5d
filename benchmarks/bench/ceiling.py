"""``neurad bench ceiling``: how well the material fields could do if the truth itself were photographed."""

import argparse

from neurad.core.ranges import Positive, option


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    from benchmarks.bench.options import add_settings

    add_settings(parser)
    parser.add_argument(
        "--seconds", type=option(Positive), default=60.0, help="length of the fit, set-up left out (default: 60)"
    )


def run(options: argparse.Namespace) -> None:
    """Fit the config's albedo and roughness fields to the true maps of the training views; print held-out scores.

    Whatever recovers materials from photographs with the same fields cannot be expected to score higher. The
    best constant of a table is fitted to the pixels that it scores, and the lookup from the true colour to roughness to
    training views. Which pixels are lit and glossy is estimated with
    the true materials.

    Raises:
        InputError: the settings are wrong, or the scene has no true maps of its training views.
    """
    from lightning.pytorch.callbacks import Timer

    from benchmarks.bench.session import prepare
    from benchmarks.bench.supervised import TrueMaps
    from neurad.assembly.build import build_world
    from neurad.callbacks.table import score_table
    from neurad.integrators.method import SceneModel
    from neurad.integrators.path import PathTracing
    from neurad.metrics.held_out import HeldOut
    from neurad.metrics.held_out_scores import score
    from neurad.metrics.lit_glossy import lit_glossy
    from neurad.optim.polyak_average import averaged
    from neurad.scene.textures import TrueMaterials

    trainer, module, data = prepare(options, 10**9)
    trainer.callbacks = [Timer({"seconds": options.seconds}), TrueMaps()]  # type: ignore[attr-defined]
    trainer.fit(module, data)
    print(f"supervised ceiling after {module.iteration} steps in {options.seconds:g} s")
    world = build_world(module.scene)  # with the true light, where the fit's own is unknown
    held_out = HeldOut(module.scene, world.geometry, world.tracer)
    model = SceneModel(world, TrueMaterials(module.scene, world.geometry))
    regions = {"lit_glossy": lit_glossy(held_out, PathTracing(None), model)}
    with averaged(module.assembly.average):
        scores = score(held_out, held_out.predict(module.assembly.materials), None, regions)
    print(score_table(scores, 0, "the fields"))
    if (r2 := scores.get("roughness_r2_lookup")) is not None:
        print(f"\nthe true colour explains {100 * r2:.0f} % of the roughness (R2 of the lookup {r2:.3f})")
