"""What scores mean, in words."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from neurad.core.decibels import FINEST, decibels
from neurad.core.parameters import RECOVERED

CLOSELY, ROUGHLY = 10.0, 3.0
"""Decibels above the best constant: nine tenths of what a constant leaves unexplained is explained, and half of it."""
KINDS = {**{name: f"{name}_psnr" for name in RECOVERED}, "the pictures": "psnr_srgb"}
"""What is judged, and by which score; its best constant's has ``_constant`` behind."""
PARTS = {"_seen": "surfaces that photographs show", "_lit_glossy": "glossy surfaces with light on them"}
"""Parts of the views that have scores of their own, by what ends the names of these."""


@dataclass(frozen=True)
class Verdict:
    """What came out of a run."""

    sentence: str
    """Everything in one."""
    warnings: list[str]
    """A sentence for each quantity that is not above the best constant."""


def verdict(scores: Mapping[str, float], views: str = "held-out views") -> Verdict:
    """Judge the scores of a run, by their names in ``metrics.csv``."""
    parts, warnings = [], []
    for what, name in KINDS.items():
        score, constant = scores.get(name), scores.get(f"{name}_constant")
        if score is None or constant is None:
            continue
        several = what == "the pictures"
        gain = score - constant
        how = "closely" if gain >= CLOSELY else "roughly" if gain >= ROUGHLY else "hardly" if gain > 0 else None
        beside = "is exact" if constant == math.inf else f"has {constant:.1f}"
        figures = f"({decibels(score, 1)}; the best constant {beside})"
        if constant > FINEST:  # nothing is above it
            parts.append(f"{what} {'are' if several else 'is'} the same everywhere {figures}")
        elif how is None:
            parts.append(f"{what} {'are' if several else 'is'} not recovered {figures}")
            warnings.append(_below(what, name, scores))
        else:
            warnings += _below_in_parts(what, name, scores)
            parts.append(f"{what} {how} {'follow the photographs' if several else 'follows the truth'} {figures}")
    if not parts:
        return Verdict(f"There is nothing in the {views} that the result could be judged by.", [])
    text = parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])}, and {parts[-1]}"
    unknown = "" if "albedo_psnr" in scores else "; no true materials are known to judge albedo and roughness by"
    return Verdict(f"In the {views} {text}{unknown}.", warnings)


def _below_in_parts(what: str, name: str, scores: Mapping[str, float]) -> list[str]:
    """Where something is below the best constant although it is not over everything."""
    found = []
    for end, words in PARTS.items():
        score, constant = scores.get(f"{name}{end}"), scores.get(f"{name}_constant{end}")
        if score is not None and constant is not None and score <= constant <= FINEST:
            found.append(f"{_not_above(what)} on {words}: {score:.2f} dB against {constant:.2f} dB.")
    return found


def _below(what: str, name: str, scores: Mapping[str, float]) -> str:
    """That something is below the best constant, and whether it is where photographs look."""
    score, constant = scores[name], scores[f"{name}_constant"]
    mean = "the photographs' mean" if what == "the pictures" else f"the mean true {what} everywhere"
    text = (
        f"{_not_above(what)}: {mean} would score {constant:.2f} dB, this result has {score:.2f} dB. Do not rely on it"
    )
    seen, level = scores.get(f"{name}_seen"), scores.get(f"{name}_constant_seen")
    if seen is None or level is None or level > FINEST or seen <= level:
        return f"{text}."
    return (
        f"{text} where no photograph looks; on surfaces that photographs show it has {decibels(seen)}, and their "
        f"best constant {level:.2f} dB."
    )


def _not_above(what: str) -> str:
    return f"{what[0].upper()}{what[1:]} {'are' if what == 'the pictures' else 'is'} not above the best constant"
