"""What the verification of an exported folder found, and which bounds it keeps."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from neurad.core.records import FloatArray, View
from neurad.export.pictures import ERROR, Pictures
from neurad.export.seams import BOUND, Seams
from neurad.metrics.scores import psnr

ALBEDO_LOSS, ROUGHNESS_LOSS, PICTURE_LOSS = 0.1, 0.1, 0.05
"""Most that baking may lose, in dB."""
MITSUBA_MEAN, MITSUBA_PSNR = 0.01, 0.1
"""Largest difference of a view's mean, as a fraction, and of the PSNR against the photographs, in dB."""
CYCLES_MEAN = 0.03
SIGMAS = 3.0
"""A mean is beyond its bound if it is so by more than this many standard errors: noise is no difference."""
SEAMS_BEYOND = 1e-2
"""Largest fraction of the points on borders of charts that may differ by more than two steps of 255."""


@dataclass
class Verified:
    """What was found."""

    views: list[View]
    held_out: bool
    """Whether the views are held out; a scene without such views is verified on those that it was fitted to."""
    pictures: dict[str, Pictures] = field(default_factory=dict)
    """By renderer: 'fields', 'baked', 'mitsuba' and 'cycles'."""
    photographs: list[FloatArray | None] = field(default_factory=list)
    scores: dict[str, float] = field(default_factory=dict)
    seams: Seams | None = None
    left_out: list[str] = field(default_factory=list)
    """What could not be verified, and why."""
    beyond: list[str] = field(default_factory=list)
    """What lies beyond its bound, a few words each."""
    noisy: list[str] = field(default_factory=list)
    """Which means are not known as well as was asked for."""

    def ratios(self, name: str) -> list[float]:
        """Means of the views by a renderer over those of the baked room in neurad's path tracer."""
        pairs = zip(self.pictures[name].mean, self.pictures["baked"].mean, strict=True)
        return [float(theirs.mean() / max(float(ours.mean()), 1e-30)) for theirs, ours in pairs]

    def errors(self, name: str) -> list[float]:
        """Standard errors of the ratios of :meth:`ratios`."""
        ours, theirs = self.pictures["baked"], self.pictures[name]
        parts = [[e / max(abs(float(x.mean())), 1e-30) for e, x in zip(p.error, p.mean, strict=True)]
                 for p in (ours, theirs)]  # fmt: skip
        return [math.hypot(a, b) for a, b in zip(*parts, strict=True)]

    def psnr(self, name: str, view: int | None = None) -> float | None:
        """Of a renderer's views, or of one, against the photographs, linear, peak 1; None without photographs.

        The noise of the renderer, known from its passes, is taken out, as renderers differ in it.
        """
        squared = self._squared(name, view)
        return None if squared is None else psnr(max(squared[0], 1e-12))

    def psnr_error(self, name: str, view: int | None = None) -> float:
        """Standard error of :meth:`psnr` in dB."""
        squared = self._squared(name, view)
        return 0.0 if squared is None else 10.0 / math.log(10.0) * squared[1] / max(squared[0], 1e-12)

    def _squared(self, name: str, view: int | None) -> tuple[float, float] | None:
        """Mean squared difference to the photographs, and its standard error."""
        shown = self.pictures[name]
        pairs = [
            (x, e)
            for i, (x, e) in enumerate(zip(shown.squared, shown.squared_error, strict=True))
            if x is not None and view in (None, i)
        ]
        if not pairs:
            return None
        return float(np.mean([x for x, _ in pairs])), math.hypot(*(e for _, e in pairs)) / len(pairs)

    def as_json(self) -> dict[str, Any]:
        """What ``verify.json`` holds."""
        return {
            "verified_on": "held-out views" if self.held_out else "training views, as there are no held-out ones",
            "scores": {name: round(value, 4) for name, value in self.scores.items()},
            "seams": None if self.seams is None else self.seams.as_json(),
            "psnr_less_baked": {
                name: self._less_baked(name) for name in ("fields", "mitsuba") if name in self.pictures
            },
            "beyond_bounds": self.beyond,
            "noisy": self.noisy,
            "left_out": self.left_out,
            "renderers": {name: self._renderer(name) for name in self.pictures},
        }

    def _less_baked(self, name: str) -> dict[str, float]:
        """What :meth:`difference` says, for ``verify.json``."""
        return dict(zip(("db", "standard_error"), (round(x, 4) for x in self.difference(name)), strict=True))

    def _renderer(self, name: str) -> dict[str, Any]:
        """What ``verify.json`` says of a renderer."""
        shown, ratios = self.pictures[name], self.ratios(name)
        worst = int(np.argmax(np.abs(np.array(ratios) - 1.0)))
        means = [float(np.mean([x.mean() for x in p.mean])) for p in (shown, self.pictures["baked"])]
        return {
            "psnr_linear": self.psnr(name),
            "psnr_standard_error": self.psnr_error(name),
            "ratio_of_means": means[0] / max(means[1], 1e-30),
            "worst_view": {"name": self.views[worst].name, "ratio_of_means": ratios[worst]},
            "views": {
                view.name: {
                    "mean": float(shown.mean[i].mean()),
                    "standard_error": shown.error[i],
                    "passes": shown.passes[i],
                    "ratio_of_means": ratios[i],
                    "psnr_linear": self.psnr(name, i),
                    "psnr_standard_error": self.psnr_error(name, i),
                }
                for i, view in enumerate(self.views)
            },
        }

    def judge(self) -> None:
        """Find what lies beyond its bound, and what noise leaves open."""
        for what, bound in (("albedo", ALBEDO_LOSS), ("roughness", ROUGHNESS_LOSS)):
            before, after = self.scores.get(f"{what}_psnr_fields"), self.scores.get(f"{what}_psnr_baked")
            if before is not None and after is not None and before - after > bound:
                self.beyond.append(f"baking took {before - after:.2f} dB of {what} (bound {bound})")
        if self.seams is not None and self.seams.beyond > SEAMS_BEYOND:
            self.beyond.append(
                f"seams: {100 * self.seams.beyond:.2f} % of the borders of charts differ by more than "
                f"{255 * BOUND:g}/255, most on {self.seams.where} ({255 * self.seams.largest:.1f}/255)"
            )
        for name, bound in (("mitsuba", MITSUBA_MEAN), ("cycles", CYCLES_MEAN)):
            if name in self.pictures:
                self._judge_means(name, bound)
        lost, error = self.difference("fields")
        if lost - SIGMAS * error > PICTURE_LOSS:
            self.beyond.append(f"baking took {lost:.2f} dB of the picture (bound {PICTURE_LOSS})")
        elif error > PICTURE_LOSS:
            self.noisy.append(f"what baking took of the picture is known to {error:.2f} dB; raise --spp")
        if "mitsuba" in self.pictures:
            apart, error = self.difference("mitsuba")
            if abs(apart) - SIGMAS * error > MITSUBA_PSNR:
                self.beyond.append(f"mitsuba's PSNR differs from ours by {apart:+.2f} dB (bound {MITSUBA_PSNR})")
            elif error > MITSUBA_PSNR:
                self.noisy.append(f"how far mitsuba's PSNR is from ours is known to {error:.2f} dB; raise --spp")

    def difference(self, name: str) -> tuple[float, float]:
        """PSNR of a renderer less that of the baked room in neurad, in dB, and its standard error; zeros without."""
        ours, theirs = self.pictures["baked"], self.pictures[name]
        views = [i for i, half in enumerate(ours.halves) if half is not None and theirs.halves[i] is not None]
        squared = self._squared("baked", None)
        if not views or squared is None:
            return 0.0, 0.0
        pairs = [theirs.farther(ours, view) for view in views]
        base = max(squared[0], 1e-12)
        farther = max(float(np.mean([off for off, _ in pairs])) / base, -0.99)
        error = math.hypot(*(e for _, e in pairs)) / len(pairs) / base
        return -10.0 * math.log10(1.0 + farther), 10.0 / math.log(10.0) * error / (1.0 + farther)

    def _judge_means(self, name: str, bound: float) -> None:
        """Compare the means of the views with ours."""
        ratios, errors = self.ratios(name), self.errors(name)
        off = [abs(ratio - 1.0) - SIGMAS * error for ratio, error in zip(ratios, errors, strict=True)]
        worst = int(np.argmax(off))
        if off[worst] > bound:
            view = self.views[worst].name
            self.beyond.append(f"{name} shows {view} {ratios[worst]:.3f} times as bright (bound {100 * bound:g} %)")
        elif max(errors) > 2.0 * ERROR:
            view = self.views[int(np.argmax(errors))].name
            self.noisy.append(
                f"{name}: the means are known to {100 * max(errors):.1f} % ({view}); raise --spp to know them better"
            )
