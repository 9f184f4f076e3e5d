"""What a report has of a run: its settings, its evaluations, and how its process ended. Imports nothing heavy."""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml  # type: ignore[import-untyped]

from neurad.core.errors import InputError
from neurad.core.parameters import RECOVERED
from neurad.metrics.marks import MARKS
from neurad.runtime.reading import similar
from neurad.runtime.tables import read_numbers

FACTS = "compare.json"
"""File in a run folder with what the comparison that started it recorded."""
SCORES = (*(f"{name}_{score}" for name in RECOVERED for score in ("psnr", "mape")), "psnr_srgb", "lamp_error")

GUESSED = "after Zhang et al. 2026, from the abstract"
"""What labels of a method say that was made after an abstract."""
FULL_NAMES = {
    "ours": "Radiometric prior (ours)",
    "no_prior": "Radiance field without prior",
    "blend": f"Blended cache ({GUESSED})",
    "debiased": "Radiometric prior, debiased",
    "direct": "Direct light (AD-Direct)",
    "path": "Path tracing (AD-PT)",
    "prb": "Path replay (PRB)",
}
"""What figures call the shipped methods."""

STAGES = {
    "model.roughness.begin": ("where roughness begins", "middle"),
    "model.diffuse_lobe": ("diffuse lobe", "files"),
    "model.metallic.recover": ("metals", "none"),
    "model.roughness.structure": ("roughness refinement", "free"),
    "data.validation_pixels": ("filter of levels", 0.0),
}
"""Stages of a fit that any method may have behind it: their setting, their name, and the value without them."""

Row = dict[str, float]


@dataclass
class Run:
    """One fit, finished or failed."""

    method: str
    seed: int
    folder: Path
    config: Mapping[str, Any] = field(default_factory=dict)
    rows: list[Row] = field(default_factory=list)
    """Evaluations in order, by the columns of ``metrics.csv``; ``samples`` wherever it can be computed."""
    columns: list[str] = field(default_factory=list)
    """Columns of ``metrics.csv`` in the file's order."""
    peak_memory_mib: float | None = None
    processor_seconds: float | None = None
    """Seconds of all threads of the run's process."""
    message: str = ""
    """Why it failed; empty if it did not."""

    @property
    def last(self) -> Row:
        """The scores that the run ended with."""
        return self.rows[-1] if self.rows else {}


def samples_per_step(config: Mapping[str, Any]) -> int | None:
    """Path samples that one iteration draws: pixels x samples per pixel x samples per vertex, twice that where the
    picture is rendered twice; None if the settings do not say.
    """
    data, model = config.get("data") or {}, config.get("model") or {}
    try:
        sampling = model["sampling"]
        passes = 2 if model["objective"]["estimator"] == "two_pass" else 1
        pixels = int(data["patches"]) * int(data["patch_size"]) ** 2
        return passes * pixels * int(sampling["spp"]) * int(sampling["samples_per_vertex"])
    except (KeyError, TypeError, ValueError):
        return None


def stages(config: Mapping[str, Any]) -> str:
    """The stages that a run's settings ask for: all, none, or their names; empty if the settings do not say."""
    found = []
    for key, (name, without) in STAGES.items():
        value = _setting(config, key)
        if value is None:
            return ""
        if value != without:
            found.append(name)
    return "all" if len(found) == len(STAGES) else ", ".join(found) or "none"


def read_run(folder: Path, method: str | None = None) -> Run:
    """A run folder as a run.

    Args:
        folder: has ``config.yaml`` and ``metrics.csv``, and :data:`FACTS` if a comparison started it.
        method: its label; by default what the comparison called it, or else the folder's name.

    Raises:
        InputError: the folder is no run, or a file in it is unreadable.
    """
    facts = _facts(folder)
    metrics, settings = folder / "metrics.csv", folder / "config.yaml"
    failed = str(facts.get("message", ""))
    for path in (settings, metrics):
        if not failed and not path.is_file():
            raise InputError(f"{folder}: it is no finished run, {path.name} is missing")
    config = _mapping(settings, "YAML", yaml.safe_load) if settings.is_file() else {}
    columns, rows = read_numbers(metrics, ("iteration", "seconds"))
    if not rows and not failed:
        raise InputError(f"{metrics}: it has no evaluation")
    per_step = samples_per_step(config)
    if per_step is not None:
        for row in rows:
            row.setdefault("samples", row["iteration"] * per_step)
    seed = facts.get("seed", config.get("seed_everything"))
    return Run(
        method=_label(method or str(facts.get("method", folder.resolve().name)), config),
        seed=int(seed) if isinstance(seed, int) else 0,
        folder=folder,
        config=config,
        rows=rows,
        columns=columns,
        peak_memory_mib=facts.get("peak_memory_mib"),
        processor_seconds=facts.get("processor_seconds"),
        message=failed,
    )


def _label(name: str, config: Mapping[str, Any]) -> str:
    """A name for a run, which says of a method that was made after an abstract that it was."""
    own = str(_setting(config, "model.method.class_path"))
    return f"{name} ({GUESSED})" if own.endswith(".blend.Blend") and name != "blend" else name


def _setting(config: Mapping[str, Any], key: str) -> Any:
    value: Any = config
    for part in key.split("."):
        value = value.get(part) if isinstance(value, Mapping) else None
    return value


def read_other(word: str) -> Run:
    """What another program found in the scene of the runs beside it.

    Args:
        word: ``NAME=DIR``, a folder with maps of held-out views, as :func:`neurad.compare.views.predicted` finds them,
            with ``metrics.csv``, whose columns are ``seconds`` and scores by the names of a run's, or both.

    Raises:
        InputError: it has neither, or a file in it is unreadable.
    """
    name, _, path = word.partition("=")
    folder = Path(path)
    if not name or not path:
        raise InputError(f"--run {word}: it has to be NAME=DIR")
    if not folder.is_dir():
        raise InputError(f"--run {word}: there is no such folder{similar(folder)}")
    metrics = folder / "metrics.csv"
    columns, rows = read_numbers(metrics, ["seconds"])
    if not rows and next(folder.glob("*/*.exr"), None) is None:
        raise InputError(f"--run {word}: it has neither metrics.csv nor maps such as albedo/VIEW.exr")
    return Run(name, 0, folder, rows=rows, columns=columns)


def runs_in(report: Path) -> list[Path]:
    """The run folders in the folder of a report, in the order in which they were made."""
    folders = [folder for folder in (report / "runs").iterdir() if folder.is_dir()]
    return sorted(folders, key=lambda folder: (float(_facts(folder).get("order", math.inf)), folder.name))


def _facts(folder: Path) -> Mapping[str, Any]:
    path = folder / FACTS
    return _mapping(path, "JSON", json.loads) if path.is_file() else {}


def _mapping(path: Path, kind: str, read: Callable[[str], Any]) -> Mapping[str, Any]:
    try:
        found = read(path.read_text())
    except (yaml.YAMLError, ValueError, OSError) as error:
        raise InputError(f"{path}: it is not readable {kind}") from error
    if not isinstance(found, dict):
        raise InputError(f"{path}: it is not a mapping of keys to values")
    return found


def by_method(runs: Sequence[Run]) -> dict[str, list[Run]]:
    """Runs grouped by method, in the order of their first appearance."""
    groups: dict[str, list[Run]] = {}
    for run in runs:
        groups.setdefault(run.method, []).append(run)
    return groups


def full_name(method: str) -> str:
    """What figures call a method: one of one's own as it is called."""
    return FULL_NAMES.get(method, method)


def marks(runs: Sequence[Run]) -> dict[str, Row]:
    """What the best constant and, of roughness, a lookup by the true colours would score on the held-out views: by
    their label and the names of :data:`SCORES`, those that have any.

    They depend on the ground truth alone, so any run that has it will do.
    """
    found: dict[str, Row] = {}
    for label, suffix in MARKS.items():
        for name in SCORES:
            values = [run.last[f"{name}{suffix}"] for run in runs if f"{name}{suffix}" in run.last]
            if values:
                found.setdefault(label, {})[name] = values[0]
    return found
