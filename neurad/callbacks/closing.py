"""What a run ends with: a verdict in words, the page that shows it, and how to go on."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import lightning.pytorch as pl

from neurad.callbacks import report
from neurad.callbacks.board import method_name
from neurad.callbacks.run_folder import RunFolder
from neurad.callbacks.table import MetricsTable
from neurad.callbacks.verdict import KINDS, verdict
from neurad.core.durations import short
from neurad.core.errors import InputError
from neurad.core.parameters import RECOVERED
from neurad.evidence.bars_file import NAME as BARS_FILE
from neurad.evidence.bars_file import read_bars
from neurad.metrics.limits import sentence_of_limits, sentence_of_roughness
from neurad.metrics.unseen import Unseen
from neurad.training.schedule import time_limit

if TYPE_CHECKING:
    from neurad.training.evaluate import Evaluation
    from neurad.training.inverse import InverseRenderer


READING = (
    "a score of 20 dB is a typical error of 0.1, 30 dB of 0.03, 40 dB of 0.01; the best constant is the one answer for "
    "all surfaces that fits best, and what is not above it was not recovered"
)
"""How to read the scores."""
MIN_SHARE = 2 / 3
"""Fraction of the processor time that a fit asks for below which a line names what it got. With nothing else running it
gets 0.9: its threads wait for each other."""


def title_of(module: InverseRenderer) -> str:
    """Scene, method and how far it got."""
    return f"{module.scene.name}, {method_name(module)}, step {module.iteration}"


def views_of(module: InverseRenderer) -> str:
    """What the scores of a scene are of."""
    return "held-out views" if module.scene.scores_are_of is None else "training photographs"


def busy(module: InverseRenderer) -> str:
    """That something else had the processor; empty where the fit got enough of it, or nobody knows."""
    share = module.spent.processor_share
    if share >= MIN_SHARE:
        return ""
    return (
        f"{module.iteration} iterations in {module.spent.seconds:.0f} s: the fit got {100 * share:.0f} % of the "
        "processor time that it asked for, as something else was running; on a quiet computer it does more of them"
    )


def print_closing(
    trainer: pl.Trainer,
    folder: Path | None,
    scores: Mapping[str, float],
    unseen: Unseen | None,
    tested: bool,
    causes: Sequence[str] = (),
) -> None:
    """The last lines of ``fit`` and ``test``: what was recovered, how well, where not to trust it, how to go on."""
    module: InverseRenderer = trainer.lightning_module  # type: ignore[assignment]
    views = views_of(module)
    judged = verdict(scores, views)
    said = [
        *(f"warning: {cause}" for cause in causes),
        judged.sentence,
        busy(module) or f"{module.iteration} iterations in {module.spent.seconds:.0f} s",
        *judged.warnings,
        "" if unseen is None else unseen.sentence(f"the {views}"),
        "" if folder is None else _determined(folder, module),
        sentence_of_limits(scores),
        sentence_of_roughness(scores),
        _absorbed(module),
        READING if any(name in scores for name in KINDS.values()) else "",
    ]
    if folder is not None:
        page, distrusted = folder / report.NAME, _distrusted(folder, unseen)
        images = ", images/, metrics.json" if tested else ""
        said += [
            f"do not trust {distrusted}" if distrusted else "",
            f"open {page} in a browser for pictures, scores and charts" if page.is_file() else "",
            f"run folder {folder}: {report.NAME}{images}, metrics.csv, config.yaml, checkpoints/",
        ]
    print("\n".join(f"neurad: {text}" for text in said if text))
    if folder is not None:
        steps = list(_next_steps(trainer, folder, tested))
        width = max(len(command) for command, _ in steps)
        print("go on with", *(f"  {command:<{width}}  {text}" for command, text in steps), sep="\n")


def _absorbed(module: InverseRenderer) -> str:
    """How many paths through mirrors and glass were cut short; empty where none was."""
    delta = module.assembly.world.delta
    if delta is None or int(delta.absorbed) == 0:
        return ""
    return (
        f"{int(delta.absorbed)} paths met more mirrors or panes in a row than are followed, and count as absorbed "
        f"({100 * int(delta.absorbed) / int(delta.begun):.2g} % of those that met one)"
    )


def _distrusted(folder: Path, unseen: Unseen | None) -> str:
    """Which surfaces a result may be wrong on, as far as pictures show it."""
    parts = ["surfaces that the pictures hatch, which no photograph shows"] if unseen and unseen.fraction else []
    if (folder / BARS_FILE).is_file():
        parts.append(f"{'those' if parts else 'surfaces'} with thin pale lines, whose error bars are wide")
    return ", and ".join(parts)


def _determined(folder: Path, module: InverseRenderer) -> str:
    """On how much of the surface photographs determine what was recovered; empty where there are no error bars."""
    try:
        bars = read_bars(folder / BARS_FILE)
    except InputError:
        return ""
    return bars.sentence if bars.iteration == module.iteration else ""


def _own_modules(trainer: pl.Trainer) -> list[str]:
    """Modules of the user's own that classes of the run are in."""
    module: InverseRenderer = trainer.lightning_module  # type: ignore[assignment]
    settings = module.settings
    kinds = (getattr(settings, name).kind for name in (*RECOVERED, "radiance"))
    named = settings.method, getattr(trainer.datamodule, "reader", None), *kinds  # type: ignore[attr-defined]
    return sorted({type(x).__module__.split(".")[0] for x in named} - {"builtins", __name__.split(".")[0]})


def _next_steps(trainer: pl.Trainer, folder: Path, tested: bool) -> Iterator[tuple[str, str]]:
    """Commands that go on from here, and what they do."""
    here = folder.parent.name == "lightning_logs" and folder.parent.resolve().parent == Path.cwd()
    run = folder.name if here else str(folder)
    own = _own_modules(trainer)
    run += f" --trust {','.join(own)}" if own else ""
    if not tested:
        yield f"neurad test --ckpt_path {run}", "pictures of every held-out view, scores with more samples"
    limit = time_limit(trainer)
    if limit is not None or trainer.max_steps > 0:
        longer = f"max_steps {2 * trainer.max_steps}" if limit is None else f"max_time {short(2 * limit)}"
        yield f"neurad fit --ckpt_path {run} --trainer.{longer}", "the same fit for as long again"
    needs = "" if find_spec("viser") else " (after pip install 'neurad[view]')"
    yield (
        f"neurad view --ckpt_path {run}",
        f"the room in the browser: any camera, lamps dimmed, materials read out{needs}",
    )
    needs = "" if find_spec("xatlas") else " (after pip install 'neurad[export]')"
    yield (
        f"neurad export --ckpt_path {run} --out room",
        f"textures for Blender, glTF viewers and Mitsuba; with --into FILE in your own .blend or .glb{needs}",
    )
    yield f"tensorboard --logdir {folder.parent}", "curves and pictures of all runs, also while one trains"


def report_run(
    trainer: pl.Trainer,
    folder: Path,
    evaluation: Evaluation,
    unseen: Unseen,
    pictured: str,
    tested: bool,
    causes: Sequence[str] = (),
) -> None:
    """Write ``report.html``."""
    module: InverseRenderer = trainer.lightning_module  # type: ignore[assignment]
    drawn = f"{module.samples / 1e6:.3g} million path samples"
    spent = f"{module.iteration} iterations in {module.spent.seconds:.0f} s, {drawn}"
    distrusted = _distrusted(folder, unseen)
    report.write_report(
        folder / report.NAME,
        title_of(module),
        evaluation,
        unseen,
        views=views_of(module),
        number=len(module.scene.scored),
        rows=MetricsTable(folder / "metrics.csv").rows(),
        warnings=[busy(module), *causes],
        trust=[_determined(folder, module), f"Do not trust {distrusted}." if distrusted else ""],
        facts=[f"{folder}: {spent}. Pictures by {pictured}.", module.scene.scores_are_of or ""],
        steps=list(_next_steps(trainer, folder, tested)),
    )


def settings_of(trainer: pl.Trainer) -> dict[str, Any]:
    """Settings of a run that are not the model's, for TensorBoard's tab of hyperparameters."""
    callbacks = trainer.callbacks  # type: ignore[attr-defined]
    config: Any = next((callback.config for callback in callbacks if isinstance(callback, RunFolder)), {})
    names = {"Seed": "seed_everything", "Steps": "trainer.max_steps", "Time": "trainer.max_time"}
    names |= {key: key for key in ("data.patches", "data.patch_size")}
    return {label: config[name] for label, name in names.items() if name in config}
