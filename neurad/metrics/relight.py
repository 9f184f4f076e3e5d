"""Scores of recovered materials under light that they were not recovered from."""

from collections.abc import Sequence

from neurad.core.records import FloatArray
from neurad.core.scene_records import EnvironmentMap
from neurad.images.lat_long import read_map
from neurad.metrics.held_out import HeldOut
from neurad.metrics.scores import Pool
from neurad.scene.description import Scene


def relight_map(scene: Scene) -> EnvironmentMap | None:
    """The other environment, in the frame of the scene's own; None if there is none.

    Raises:
        InputError: it cannot be read, or a value is none to compute with.
    """
    if scene.relight is None:
        return None
    frame = {} if scene.environment is None else {"to_world": scene.environment.to_world}
    return EnvironmentMap(read_map(scene.relight), **frame)


def score_relit(held_out: HeldOut, renders: Sequence[FloatArray]) -> dict[str, float]:
    """Scores of pictures [h, w, 3] of every held-out view against its relit photograph; views without one are left out.

    Returns:
        ``relight_psnr_linear`` over all pixels but masked ones and ``relight_mape_linear`` over those of them that show
        a surface; also with ``_scaled1`` and ``_scaled3``, after the best factor for all channels together or for each.
    """
    everywhere, surfaces = Pool(), Pool()
    for index, render in enumerate(renders):
        truth = held_out.truth(index).get("photograph_relit")
        if truth is not None:
            kept = held_out.kept(index)
            everywhere.add(render, truth, kept)
            surfaces.add(render, truth, kept & held_out.shows(index))
    scores = {}
    for kind, pool in (("psnr", everywhere), ("mape", surfaces)):
        for score, value in pool.scores(scaled=True).items():
            name, _, scale = score.partition("_")
            if name == kind and scale != "constant":
                scores["_".join(part for part in ("relight", kind, "linear", scale) if part)] = value
    return scores
