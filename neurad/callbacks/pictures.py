"""Pictures of an evaluation: tone-mapped pages for TensorBoard, EXR and PNG files for ``neurad test``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from neurad.runtime.files import make_folder
from neurad.runtime.progress import counted
from neurad.scene.image_io import to_srgb, write_exr, write_png

Image = npt.NDArray[np.float32]
Bytes = npt.NDArray[np.uint8]
View = Mapping[str, Any]
BRIGHTEST_STD = 0.2
"""Standard deviation that pictures of error bars show brightest; next to nothing is known there."""


def view_name(view: View, index: int) -> str:
    """The view's name, or its number."""
    return str(view.get("name") or f"{index:03d}").replace("/", "_")


def exposure(maps: Sequence[View]) -> float:
    """One factor for all pictures of a run, from the photographs alone: it must not follow the fit, or it would
    hide its progress. The 90th percentile of the photographs becomes 0.8.
    """
    photographs = [view["photograph"] for view in maps if view.get("photograph") is not None]
    if not photographs:
        return 1.0
    level = float(np.percentile(np.concatenate([p.reshape(-1) for p in photographs]), 90))
    return 0.8 / level if level > 0 else 1.0


def encode(image: Image) -> Bytes:
    """Linear values in [0, 1] as sRGB bytes [h, w, 3]; one channel becomes grey."""
    return np.round(to_srgb(np.broadcast_to(image, (*image.shape[:2], 3))) * 255).astype(np.uint8)


def grey(image: Image) -> Bytes:
    """Values in [0, 1] as bytes without a curve: roughness is no light."""
    return np.round(np.clip(np.broadcast_to(image, (*image.shape[:2], 3)), 0, 1) * 255).astype(np.uint8)


def false_colour(error: Image, scale: float) -> Bytes:
    """The mean over channels of ``error`` [h, w, c], black at 0 and bright at ``1 / scale``."""
    from matplotlib import colormaps

    return np.asarray(colormaps["inferno"](np.clip(error.mean(axis=-1) * scale, 0, 1), bytes=True)[..., :3])


def pages(view: View, scale: float) -> dict[str, Bytes]:
    """The pictures of one view, side by side, those that have what they need.

    Args:
        view: arrays [h, w, c] by name: render, photograph, albedo, albedo_true, roughness, roughness_true, residual,
            albedo_std, roughness_std.
        scale: exposure of radiance; an error of a quarter of display white is the brightest in the error pictures.
    """
    has = {name for name in view if view[name] is not None}
    result = {}
    if {"render", "photograph"} <= has:
        result["render_photograph_error"] = _compared(view["render"], view["photograph"], scale)
    if {"relit", "photograph_relit"} <= has:
        result["relit_photograph_error"] = _compared(view["relit"], view["photograph_relit"], scale)
    for name, show in (("albedo", encode), ("roughness", grey)):
        if name in has:
            shown = [view[name], view[f"{name}_true"]] if f"{name}_true" in has else [view[name]]
            result["_".join([name, "truth"][: len(shown)])] = _beside([show(image) for image in shown])
    for name in ("albedo_std", "roughness_std"):
        if name in has:
            result[name] = false_colour(view[name], 1.0 / BRIGHTEST_STD)
    if "residual" in has:
        result["residual_lhs_rhs"] = false_colour(np.abs(view["residual"]), 4 * scale)
    return result


def _compared(render: Image, photograph: Image, scale: float) -> Bytes:
    """A rendering, its photograph and the error, side by side."""
    error = np.abs(render - photograph)
    return _beside([encode(render * scale), encode(photograph * scale), false_colour(error, 4 * scale)])


def environment(maps: Mapping[str, Image], scale: float) -> Bytes:
    """A recovered environment map and, below it, the true one where it is there."""
    panels = [encode(maps[name] * scale) for name in ("fitted", "truth") if name in maps]
    line = np.full((2, panels[0].shape[1], 3), 255, np.uint8)
    return np.concatenate([part for panel in panels for part in (panel, line)][:-1])


def write_views(folder: Path, maps: Sequence[View], sky: Mapping[str, Image] | None = None) -> None:
    """Write render, albedo, roughness, their error bars and relit rendering of every view, those that it has, as linear
    EXR and as PNG for looking at; ``sky``, a recovered environment map and the true one, as ``environment``.
    """
    make_folder(folder)
    scale = exposure(maps)
    for index, view in enumerate(counted(maps, "writing", len(maps), "pictures")):
        for name in ("render", "albedo", "roughness", "relit", "albedo_std", "roughness_std"):
            image = view.get(name)
            if image is None:
                continue
            stem = folder / f"{view_name(view, index)}_{name}"
            write_exr(stem.with_suffix(".exr"), image, half=False)
            light = name in ("render", "relit")
            if name.endswith("_std"):
                shown = false_colour(image, 1.0 / BRIGHTEST_STD)
            else:
                shown = grey(image) if name == "roughness" else encode(image * scale if light else image)
            write_png(stem.with_suffix(".png"), shown)
    if sky:
        write_exr(folder / "environment.exr", sky["fitted"], half=False)
        write_png(folder / "environment.png", environment(sky, scale))


def _beside(panels: Sequence[Bytes]) -> Bytes:
    """Panels of one height next to each other, a thin white line between."""
    line = np.full((panels[0].shape[0], 2, 3), 255, np.uint8)
    parts = [part for panel in panels for part in (panel, line)][:-1]
    return np.concatenate(parts, axis=1)
