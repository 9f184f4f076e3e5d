"""What the verification of an exported folder found, and which bounds it keeps."""

import math
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from neurad.core.decibels import FINEST, as_json
from neurad.core.parameters import RECOVERED
from neurad.core.records import FloatArray
from neurad.core.scene_records import View
from neurad.export.pictures import BLOCKS, Estimate, Pictures
from neurad.export.seams import BOUND, Seams
from neurad.metrics.scores import psnr

MAP_LOSS, PICTURE_LOSS = 0.1, 0.05
"""Most that baking may lose, in dB."""
MITSUBA_MEAN, MITSUBA_PSNR = 0.01, 0.1
"""Largest difference of a view's mean, as a fraction, and of the PSNR against the photographs, in dB."""
CYCLES_MEAN = 0.03
COPY_MEAN = 0.05
"""Of a copy of a glTF file, which cannot say how Burley's lobe spreads over angles: rooms get up to 4 % darker."""
MISSED_BY, KEPT_BY = 3.0, 2.0
"""A bound is missed by what lies beyond it by more than so many standard errors, and kept by what lies within it by
more than so many; what is neither is not decided."""
SEAMS_BEYOND = 1e-3
"""Largest fraction of the points on borders of charts that may differ by more than two steps of 255."""
State = Literal["kept", "missed", "not decided"]


@dataclass(frozen=True)
class Verdict:
    """A figure against its bound."""

    name: str
    """What was measured, in few words."""
    value: float
    error: float
    """Its standard error; 0 of what has no noise."""
    bound: float
    text: str
    """A sentence with the figure, without what it comes to."""
    signed: bool = True
    """Only what is above the bound is beyond it; otherwise what is so far from 0."""

    @property
    def state(self) -> State:
        """Whether the bound is kept, missed, or noise leaves that open."""
        off = self.value if self.signed else abs(self.value)
        if off - MISSED_BY * self.error > self.bound:
            return "missed"
        return "kept" if off + KEPT_BY * self.error <= self.bound else "not decided"

    def as_json(self) -> dict[str, Any]:
        """What ``verify.json`` holds."""
        figures = {"value": round(self.value, 5), "standard_error": round(self.error, 5), "bound": self.bound}
        return {"what": self.name, **figures, "verdict": self.state}


@dataclass
class Verified:
    """What was found."""

    views: list[View]
    held_out: bool
    """Whether the views are held out; a scene without such views is verified on those that it was fitted to."""
    exposure: float = 1.0
    """What all pictures and photographs below are multiplied with, see :mod:`neurad.scene.exposure`."""
    is_mitsubas: bool = True
    """Whether Mitsuba has the diffuse lobe of the surfaces; if not, its pictures are held to :data:`CYCLES_MEAN`."""
    ours: str = "baked"
    """The pictures of neurad's path tracer that other renderers are held to: of the baked room, or of the fields."""
    pictures: dict[str, Pictures] = field(default_factory=dict)
    """By renderer: 'fields', 'baked', 'mitsuba' and 'cycles'; 'copy' is neurad's of a glTF file that was written."""
    excess: dict[str, list[dict[int, Estimate] | None]] = field(default_factory=dict)
    """By renderer, of every view: what :func:`neurad.export.pictures.excess` says of its pictures against those of the
    baked room, by the side of the blocks; None without a photograph."""
    photographs: list[FloatArray | None] = field(default_factory=list)
    scores: dict[str, float] = field(default_factory=dict)
    seams: Seams | None = None
    left_out: list[str] = field(default_factory=list)
    """What could not be verified, and why."""
    verdicts: list[Verdict] = field(default_factory=list)

    @property
    def beyond(self) -> list[str]:
        """What lies beyond its bound, a few words each."""
        return [verdict.text for verdict in self.verdicts if verdict.state == "missed"]

    @property
    def undecided(self) -> list[str]:
        """What noise leaves open, a few words each."""
        return [verdict.text for verdict in self.verdicts if verdict.state == "not decided"]

    def ratios(self, name: str) -> list[float]:
        """Means of the views by a renderer over those of neurad's path tracer; 1 of views that are black in both."""
        pairs = zip(self.pictures[name].mean, self.pictures[self.ours].mean, strict=True)
        return [max(float(theirs.mean()), 1e-30) / max(float(ours.mean()), 1e-30) for theirs, ours in pairs]

    def errors(self, name: str) -> list[float]:
        """Standard errors of the ratios of :meth:`ratios`."""
        ours, theirs = self.pictures[self.ours], self.pictures[name]
        parts = [[e / max(abs(float(x.mean())), 1e-30) for e, x in zip(p.error, p.mean, strict=True)]
                 for p in (ours, theirs)]  # fmt: skip
        return [math.hypot(a, b) for a, b in zip(*parts, strict=True)]

    def psnr(self, name: str, view: int | None = None) -> tuple[float | None, float]:
        """PSNR of a renderer's views, or of one, against the photographs, linear, of values below 1, and its standard
        error, in dB; None and 0 without photographs.

        The noise of the renderer, known from its passes, is taken out, as renderers differ in it.
        """
        squared = self._squared(name, view)
        if squared is None:
            return None, 0.0
        base = max(squared[0], 1e-12)
        return psnr(base), _decibels(squared[1] / base)

    def _squared(self, name: str, view: int | None) -> Estimate | None:
        shown = self.pictures[name].squared
        return _mean([x for i, x in enumerate(shown) if x is not None and view in (None, i)])

    def difference(self, name: str, block: int = 1) -> Estimate:
        """PSNR of a renderer less that of the baked room in neurad, in dB, by differences over blocks of this side in
        pixels, whatever is finer; zeros without photographs.
        """
        excess = _mean([entry[block] for entry in self.excess[name] if entry is not None])
        squared = self._squared("baked", None)
        if excess is None or squared is None:
            return 0.0, 0.0
        base = max(squared[0], 1e-12)
        farther = max(excess[0] / base, -0.99)
        return -10.0 * math.log10(1.0 + farther), _decibels(excess[1] / base / (1.0 + farther))

    def as_json(self) -> dict[str, Any]:
        """What ``verify.json`` holds."""
        return {
            "verified_on": "held-out views" if self.held_out else "training views, as there are no held-out ones",
            "exposure": self.exposure,
            "scores": {name: as_json(round(value, 4)) for name, value in self.scores.items()},
            "seams": None if self.seams is None else self.seams.as_json(),
            "bounds": [verdict.as_json() for verdict in self.verdicts],
            "beyond_bounds": self.beyond,
            "not_decided": self.undecided,
            "left_out": self.left_out,
            "renderers": {name: self._renderer(name) for name in self.pictures},
        }

    def _renderer(self, name: str) -> dict[str, Any]:
        shown, ratios = self.pictures[name], self.ratios(name)
        worst = int(np.argmax(np.abs(np.array(ratios) - 1.0)))
        means = [float(np.mean([x.mean() for x in p.mean])) for p in (shown, self.pictures[self.ours])]
        return {
            **dict(zip(("psnr_below_white", "psnr_standard_error"), self.psnr(name), strict=True)),
            "psnr_less_baked": {
                f"{block} x {block} pixels": dict(
                    zip(("value", "standard_error"), self.difference(name, block), strict=True)
                )
                for block in (BLOCKS if name in self.excess else ())
            },
            "ratio_of_means": means[0] / max(means[1], 1e-30),
            "worst_view": {"name": self.views[worst].name, "ratio_of_means": ratios[worst]},
            "views": {
                view.name: {
                    "mean": float(shown.mean[i].mean()),
                    "standard_error": shown.error[i],
                    "passes": shown.passes[i],
                    "ratio_of_means": ratios[i],
                    **dict(zip(("psnr_below_white", "psnr_standard_error"), self.psnr(name, i), strict=True)),
                }
                for i, view in enumerate(self.views)
            },
        }

    def judge(self) -> None:
        """Hold what was found against its bounds."""
        self.verdicts = []
        for what, (_, _, lost) in self.lost().items():
            if what != "picture":
                text = f"baking took {lost:.2f} dB of {what} (bound {MAP_LOSS})"
                self.verdicts.append(Verdict(f"{what} lost by baking, dB", lost, 0.0, MAP_LOSS, text))
        if (seams := self.seams) is not None:
            text = (
                f"seams: {100 * seams.beyond:.2f} % of the borders of charts differ by more than {255 * BOUND:g}/255, "
                f"most on {seams.where} ({255 * seams.largest:.1f}/255)"
            )
            self.verdicts.append(Verdict("fraction of borders beyond 2/255", seams.beyond, 0.0, SEAMS_BEYOND, text))
        of_mitsuba = MITSUBA_MEAN if self.is_mitsubas else CYCLES_MEAN
        for name, bound in (("mitsuba", of_mitsuba), ("cycles", CYCLES_MEAN), ("copy", COPY_MEAN)):
            if name in self.pictures:
                self.verdicts.append(self._means(name, bound))
        if "baked" not in self.pictures or all(photo is None for photo in self.photographs):
            return
        self.verdicts.append(self._compared("fields", "picture lost by baking", PICTURE_LOSS, signed=True))
        if "mitsuba" in self.pictures and self.is_mitsubas:
            self.verdicts.append(self._compared("mitsuba", "mitsuba's PSNR less ours", MITSUBA_PSNR, signed=False))

    def _compared(self, name: str, what: str, bound: float, signed: bool) -> Verdict:
        """The PSNR of a renderer less that of the baked room, by all pixels or, where noise leaves that open, by the
        smallest blocks that decide.
        """
        for block in BLOCKS:
            apart, error = self.difference(name, block)
            blocks = f" by means over {block} x {block} pixels" if block > 1 else ""
            text = f"{what} is {apart:+.3f} dB +- {error:.2g}{blocks} (bound {bound})"
            verdict = Verdict(f"{what}{blocks}, dB", apart, error, bound, text, signed)
            if verdict.state != "not decided":
                break
        return verdict

    def lost(self) -> dict[str, tuple[float, float, float]]:
        """Scores in dB of the fields and of the baked room, and what baking took, of each map and of the picture."""
        found = {}
        for what in (*RECOVERED, "picture"):
            before, after = self.scores.get(f"{what}_psnr_fields"), self.scores.get(f"{what}_psnr_baked")
            if before is not None and after is not None:
                found[what] = before, after, min(before, FINEST) - min(after, FINEST)
        return found

    def _means(self, name: str, bound: float) -> Verdict:
        """The view whose mean is farthest from ours, standard errors included."""
        ratios, errors = self.ratios(name), self.errors(name)
        off = np.abs(np.array(ratios) - 1.0)
        missed = off - MISSED_BY * np.array(errors) > bound
        worst = int(np.argmax(np.where(missed, off, 0.0) if missed.any() else off + KEPT_BY * np.array(errors)))
        ratio, error = ratios[worst], errors[worst]
        text = (
            f"{name} shows {self.views[worst].name} {ratio:.4f} times as bright +- {error:.2g} "
            f"(bound {100 * bound:g} %)"
        )
        return Verdict(f"{name}: farthest mean of a view less 1", ratio - 1.0, error, bound, text, signed=False)


def _mean(parts: list[Estimate]) -> Estimate | None:
    """The mean of independent estimates; None of none."""
    if not parts:
        return None
    return float(np.mean([x for x, _ in parts])), math.hypot(*(e for _, e in parts)) / len(parts)


def _decibels(fraction: float) -> float:
    """A small change of a squared difference, as a fraction, in dB."""
    return 10.0 / math.log(10.0) * fraction
