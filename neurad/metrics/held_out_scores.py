"""Scores of what was predicted for held-out views, in their own light and in another."""

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from neurad.core.parameters import RECOVERED
from neurad.core.records import BoolArray, Float64Array, FloatArray
from neurad.core.scene_records import EnvironmentMap, View
from neurad.images.image_io import to_srgb
from neurad.images.lat_long import read_map
from neurad.images.photographs import ceiling_of
from neurad.metrics.colour_lookup import explained
from neurad.metrics.held_out import HeldOut, Maps
from neurad.metrics.scores import Pool, block_means
from neurad.scene.description import Scene

BLOCK = 8
"""Side of the box filter in pixels of the scores named ``_8x8``."""
SCORES = {
    "linear": ("psnr",),
    "linear surfaces": ("mape",),
    "srgb": ("psnr",),
    "lhs": ("psnr",),
    **dict.fromkeys(RECOVERED, ("psnr", "mape")),
    "albedo 8x8": ("psnr",),
    "roughness lookup": ("psnr", "mape", "r2"),
}
"""What is compared, and the scores that are reported of it; ``lookup`` is no prediction but a mark, as the constant."""


def score(
    held_out: HeldOut,
    maps: Sequence[Maps],
    renders: Sequence[FloatArray] | None = None,
    regions: Mapping[str, Sequence[BoolArray]] | None = None,
    scaled: bool = False,
    fields: Sequence[FloatArray] | None = None,
) -> dict[str, float]:
    """Scores over the pooled pixels of all views; what has no ground truth is left out.

    Args:
        maps: surface parameters of every view, as :meth:`HeldOut.predict` gives them; what is missing gets no
            score.
        renders: pictures [h, w, 3] of every view, linear.
        regions: further masks [h, w] of every view, by the suffix of their scores.
        scaled: whether light and albedo are found up to a common factor only.
        fields: pictures [h, w, 3] of every view that the radiance field itself shows (the left-hand side), linear.

    Returns:
        ``psnr_srgb``, by :attr:`HeldOut.exposure`, clamped and by the sRGB curve, and ``psnr_linear``, of radiance
        with peak 1, over all pixels but masked ones, ``psnr_lhs`` (linear) likewise;
        ``mape_linear`` over those of them that show a surface; ``psnr`` and ``mape`` of every recovered parameter, such
        as ``albedo_psnr``, over counted ones, and ``albedo_psnr_8x8`` over these after a box filter. Each also with
        ``_constant``, of the best constant, those of roughness with ``_lookup``, of :attr:`HeldOut.lookup` by the true
        colours, whose fraction of explained variance is ``roughness_r2_lookup``, and those of albedo, if ``scaled``,
        with ``_scaled1`` and ``_scaled3``, after the best factor for all channels together or for each. All these also
        with ``_seen``, over pixels of surfaces that a training view sees, and with the suffixes of ``regions``.
    """
    count = range(len(held_out.views))
    masks: dict[str, Sequence[BoolArray]] = {"seen": [held_out.seen(i) for i in count], **(regions or {})}
    scores: dict[str, float] = {}
    for suffix, mask in {"": None, **masks}.items():
        pools = {name: Pool() for name in SCORES}
        for i in count:
            region = np.ones_like(held_out.counted(i)) if mask is None else mask[i]
            _pool(held_out, pools, i, maps[i], None if renders is None else renders[i], region)
            if fields is not None and "photograph" in held_out.truth(i):
                pools["lhs"].add(*_comparable(held_out, i, fields[i]), region & held_out.kept(i))
        for name, pool in pools.items():
            found = pool.scores(scaled and name.startswith("albedo"))
            if name == "lhs":  # its constant is that of the other picture
                found.pop("psnr_constant", None)
            if "lookup" in name and found:
                r2 = explained(found["psnr"], found["psnr_constant"])
                found = {"psnr": found["psnr"], "mape": found["mape"]} | ({} if math.isnan(r2) else {"r2": r2})
            for score, value in found.items():
                if score.partition("_")[0] in SCORES[name]:
                    scores[_key(name, score, suffix)] = value
    return scores


@torch.no_grad()
def responded(
    view: View, photograph: FloatArray, respond: Callable[[Tensor], Tensor], device: torch.device | str = "cpu"
) -> FloatArray:
    """A photograph [h, w, 3] by a response that was recovered; as it is where it is not of codes."""
    if not view.development.levels:
        return photograph
    gain = view.development.gain
    found = respond(torch.from_numpy(photograph * np.float32(gain)).float().to(device)).cpu().numpy() / gain
    return found.astype(np.float32)


def _comparable(held_out: HeldOut, index: int, render: FloatArray) -> tuple[FloatArray, FloatArray]:
    """A picture of a view and its photograph, as they are compared [h, w, 3] each.

    What is clipped is no error where the picture is brighter. Where gains are recovered, those of the scored
    photographs are the best in least squares; where a response is, they are developed with it.
    """
    view, photograph = held_out.views[index], held_out.truth(index)["photograph"]
    ceiling, gains = ceiling_of(view), held_out.scene.photography
    if math.isinf(ceiling) and not gains.fits_gains and held_out.respond is None:
        return render, photograph
    clipped = photograph >= ceiling
    if held_out.respond is not None:
        photograph = responded(view, photograph, held_out.respond, held_out.geometry.vertices.device)
    if gains.fits_gains:
        free = ~clipped & held_out.kept(index)[..., None]
        axes = (0, 1) if gains.white_balance == "fit" else None
        square = np.where(free, photograph, 0.0).astype(np.float64) ** 2
        product = np.where(free, photograph, 0.0).astype(np.float64) * render
        factor = product.sum(axes) / np.maximum(square.sum(axes), 1e-30)
        photograph = (photograph * np.where(factor > 0.0, factor, 1.0)).astype(np.float32)
    return np.where(clipped & (render > photograph), photograph, render), photograph


def albedo_factors(held_out: HeldOut, maps: Sequence[Maps]) -> dict[str, Float64Array]:
    """The best factors of albedo over the counted pixels of all views, as ``scaled1`` and ``scaled3`` [3]."""
    pool = Pool()
    for index, entry in enumerate(maps):
        truth = held_out.truth(index).get("albedo_true")
        if truth is not None and "albedo" in entry:
            pool.add(entry["albedo"], truth, held_out.counted(index))
    return pool.factors()


def _pool(
    held_out: HeldOut, pools: dict[str, Pool], index: int, maps: Maps, render: FloatArray | None, region: BoolArray
) -> None:
    """Add the pixels of one view in ``region`` [h, w] to the pools."""
    truth = held_out.truth(index)
    counted = held_out.counted(index) & region
    if render is not None and "photograph" in truth:
        kept = region & held_out.kept(index)
        render, photograph = _comparable(held_out, index, render)
        pools["linear"].add(render, photograph, kept)
        pools["linear surfaces"].add(render, photograph, kept & held_out.shows(index))
        shown, true = (to_srgb(image * np.float32(held_out.exposure)) for image in (render, photograph))
        pools["srgb"].add(shown, true, kept)
    for name in RECOVERED:
        if f"{name}_true" in truth and name in maps:
            pools[name].add(maps[name], truth[f"{name}_true"], counted)
    if held_out.stride == 1 and "albedo_true" in truth and "albedo" in maps:  # else blocks would be larger
        guess, weight = block_means(maps["albedo"], counted, BLOCK)
        exact, _ = block_means(truth["albedo_true"], counted, BLOCK)
        pools["albedo 8x8"].add(guess, exact, weight > 0, weight)
    if held_out.lookup is not None and {"albedo_true", "roughness_true"} <= truth.keys() and "roughness" in maps:
        pools["roughness lookup"].add(held_out.lookup(truth["albedo_true"]), truth["roughness_true"], counted)


def _key(name: str, score: str, region: str) -> str:
    """Column of a score, such as ``albedo_psnr_8x8_constant_seen``: what, score, filter, constant, region."""
    what, _, filtered = name.partition(" ")
    kind, _, constant = score.partition("_")
    images = what in ("linear", "srgb", "lhs")
    parts = (kind, what) if images else (what, kind, filtered)
    return "_".join(part for part in (*parts, constant, region) if part)


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
