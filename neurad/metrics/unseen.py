"""How much of held-out views no photograph shows, and how much of the error lies there."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from neurad.core.parameters import PARAMETERS
from neurad.core.records import BoolArray

SEEN, NEITHER, UNSEEN = 1.0, 0.5, 0.0
"""Values of the map ``seen``: a surface that a training photograph shows; an emitter, no surface, or a pixel that a
mask leaves out; a surface that none shows."""


def seen_map(counted: BoolArray, seen: BoolArray) -> npt.NDArray[np.float32]:
    """The map ``seen`` [h, w, 1] of a view, by its pixels [h, w] of surfaces alone, emitters and masked ones left out,
    and by those whose surface some training view sees.
    """
    return np.where(counted, np.where(seen, SEEN, UNSEEN), NEITHER).astype(np.float32)[..., None]


@dataclass(frozen=True)
class Unseen:
    """What of some views no photograph shows."""

    masks: list[BoolArray | None]
    """Its pixels [h, w] by view; None where that is not known."""
    fraction: float | None = None
    """Fraction of the surfaces that no training view sees; None where that is not known."""
    squared: dict[str, float] = field(default_factory=dict)
    """Fraction of the squared error that lies there, by the name of the surface parameter."""

    @classmethod
    def of(cls, views: Sequence[Mapping[str, Any]]) -> Self:
        """Unseen parts of views by their maps [h, w, c]: ``seen``, and surface parameters and their true maps, such as
        ``albedo`` and ``albedo_true``, where there are any.
        """
        masks = [view["seen"][..., 0] == UNSEEN if view.get("seen") is not None else None for view in views]
        known = [(mask, view) for mask, view in zip(masks, views, strict=True) if mask is not None]
        surfaces = sum(int((view["seen"] != NEITHER).sum()) for _, view in known)
        if surfaces == 0:
            return cls(masks)
        squared = {}
        for name in (parameter.name for parameter in PARAMETERS):
            inside = total = 0.0
            for mask, view in known:
                if view.get(name) is not None and view.get(f"{name}_true") is not None:
                    error = np.square(view[name].astype(np.float64) - view[f"{name}_true"]).mean(-1)
                    inside += float(error[mask].sum())
                    total += float(error[view["seen"][..., 0] != NEITHER].sum())
            if total > 0:
                squared[name] = inside / total
        return cls(masks, sum(int(mask.sum()) for mask, _ in known) / surfaces, squared)

    def summary(self) -> Self:
        """The numbers without the masks, which are as large as the views."""
        return replace(self, masks=[])

    def sentence(self, what: str = "the held-out views") -> str:
        """How much was never photographed; empty where that is not known."""
        if self.fraction is None:
            return ""
        if self.fraction == 0:
            return f"Every surface in {what} is in some training photograph."
        parts = [f"{percent(value)} of the squared error of {name}" for name, value in self.squared.items()]
        carried = f"; these carry {' and '.join(parts)}" if parts else ""
        return f"{percent(self.fraction)} of the surfaces in {what} are in no training photograph{carried}."


def percent(value: float) -> str:
    """A fraction in percent with the digits that matter."""
    scaled = 100.0 * value
    return f"{scaled:.0f} %" if scaled >= 9.5 else f"{scaled:.1f} %" if scaled >= 0.095 else "below 0.1 %"
