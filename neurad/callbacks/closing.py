"""What a run ends with: a verdict in words, and the page that shows it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import lightning.pytorch as pl

from neurad.callbacks import report
from neurad.callbacks.board import method_name
from neurad.callbacks.run_folder import RunFolder
from neurad.callbacks.table import MetricsTable
from neurad.callbacks.verdict import verdict
from neurad.metrics.unseen import Unseen

if TYPE_CHECKING:
    from neurad.training.evaluate import Evaluation
    from neurad.training.inverse import InverseRenderer


@dataclass(frozen=True)
class Shown:
    """The last evaluation of a fit, with as many views as are shown."""

    evaluation: Evaluation
    unseen: Unseen
    """Of all held-out views."""


def title_of(module: InverseRenderer) -> str:
    """Scene, method and how far it got."""
    return f"{module.scene.name}, {method_name(module)}, step {module.iteration}"


def views_of(module: InverseRenderer) -> str:
    """What the scores of a scene are of."""
    return "held-out views" if module.scene.scores_are_of is None else "training photographs"


def print_verdict(module: InverseRenderer, scores: Mapping[str, float], unseen: Unseen | None) -> None:
    """What came out, what is not above the best constant, and what no photograph shows."""
    views = views_of(module)
    judged = verdict(scores, views)
    said = [judged.sentence, *judged.warnings, "" if unseen is None else unseen.sentence(f"the {views}")]
    print("\n".join(f"neurad: {text}" for text in said if text))


def report_run(module: InverseRenderer, folder: Path, evaluation: Evaluation, unseen: Unseen, pictured: str) -> None:
    """Write ``report.html``."""
    seconds = module.train_seconds if module.training_views is not None else module.seconds_before
    spent = f"{module.iteration} iterations in {seconds:.0f} s, {module.samples:.3g} path samples"
    facts = [f"{folder}: {spent}. Pictures by {pictured}.", *filter(None, [module.scene.scores_are_of])]
    report.write_report(
        folder / report.NAME,
        report.Result(
            title=title_of(module),
            facts=facts,
            scores=evaluation.scores,
            maps=evaluation.maps,
            unseen=unseen,
            views=views_of(module),
            rows=MetricsTable(folder / "metrics.csv").rows(),
            environment=evaluation.environment,
            number=len(module.scene.scored),
        ),
    )


def name_report(folder: Path) -> None:
    """Say where the page is, if there is one."""
    if (folder / report.NAME).is_file():
        print(f"neurad: open {folder / report.NAME} in a browser for pictures, scores and charts")


def settings_of(trainer: pl.Trainer) -> dict[str, Any]:
    """Settings of a run that are not the model's, for TensorBoard's tab of hyperparameters."""
    callbacks = trainer.callbacks  # type: ignore[attr-defined]
    config: Any = next((callback.config for callback in callbacks if isinstance(callback, RunFolder)), {})
    names = {"Seed": "seed_everything", "Steps": "trainer.max_steps", "Time": "trainer.max_time"}
    names |= {key: key for key in ("data.patches", "data.patch_size")}
    return {label: config[name] for label, name in names.items() if name in config}
