"""The cases of ``neurad stress``, one module a family; each has ``cases()``."""

from __future__ import annotations

import importlib

from neurad.studies.stress.case import Case

FAMILIES: dict[str, str] = {
    "stiff": "albedo near 1: the field alone, its speed, and recovering the albedo",
    "surfaces": "roughness and albedo at the ends of their range",
    "light": "very bright, very dim and very small lights",
    "images": "black, scaled and spoilt photographs",
    "shapes": "size and place of the scene, bad triangles, huge meshes",
    "delta": "glass and mirrors",
    "precision": "float32 against float64, other number formats, many seeds, long runs",
    "guard": "planted NaN and Inf",
    "features": "what a scene does not need is not built",
}
"""Name (the module's name too) and what it is about."""


def collect(only: list[str] | None = None) -> list[Case]:
    """The cases of the named families, or all of them."""
    names = list(FAMILIES) if only is None else only
    return [case for name in names for case in importlib.import_module(f"{__name__}.{name}").cases()]
