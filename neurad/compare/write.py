"""All files of a report, from runs."""

import html
import platform
import shlex
from collections.abc import Sequence
from datetime import date
from pathlib import Path

from neurad.compare import curves, page, paper, table, views
from neurad.compare.runs import STAGES, Run, by_method
from neurad.compare.table import MIN_ITERATIONS
from neurad.images.image_io import write_png
from neurad.pages.draw import draw
from neurad.runtime.files import make_folder
from neurad.runtime.machine import processor, usable_cores

NOTES = (
    "Scores are those of the held-out views at the end of a run: PSNR in dB with peak 1, "
    "MAPE = mean |p - g| / (g + 0.01). The best constant is the mean of the truth over "
    "the same pixels. The true colour's lookup is a table from albedo to roughness, made of the true maps of training "
    "views and read with the true albedo: what roughness owes to following colour.",
    "Seconds run from the end of a fit's first iteration, as what comes before (the scene, camera rays, compilation) "
    "depends on what ran before; of runs that were not made for this comparison, from the start of their process. "
    "Evaluations are left out. Path samples are those drawn by training: pixels x samples per pixel x samples per "
    f"vertex. Fits of under {MIN_ITERATIONS} iterations are marked and never best.",
    "Milliseconds a step and the rates are taken between the first and the last evaluation. Peak memory is the largest "
    "resident memory of the process that fitted, processor time that of all its threads, evaluations included.",
    "Stages are what a fit does beside gradient descent, whatever its method: "
    f"{', '.join(name for name, _ in STAGES.values())}. `neurad compare --plain` fits without any.",
    "With several seeds the table has medians, and the curves have the median and a band from the lowest score to the "
    "highest.",
)


def write_report(
    out: Path,
    runs: Sequence[Run],
    reach: Sequence[float],
    count: int,
    command: Sequence[str],
    budget: str,
    trust: Sequence[str] = (),
) -> None:
    """Write index.html, the figures, table.md, table.csv and curves.csv.

    Args:
        reach: albedo PSNRs whose time the table has.
        count: held-out views to show.
        budget: what every run was given, in words; empty if unknown.
        trust: modules of the user's own that the runs' reader may be in.
    """
    make_folder(out, "--out")
    for old in [path for name in ("view_*.png", "curves_*.???", "crops.???") for path in out.glob(name)]:
        old.unlink()
    done = [run for run in runs if not run.message]
    rows = table.table(runs, reach)
    line = shlex.join(command)
    table.write_csv(out / "table.csv", rows, reach)
    note = ". ".join(part for part in (f"`{line}`", budget, machine(), date.today().isoformat()) if part)
    table.write_markdown(out / "table.md", rows, note + ".", reach)
    curves.write_csv(out / "curves.csv", runs)
    paper.write_curves(out, done)
    further = {
        "Against processor time": curves.charts(done, "processor_seconds", 0),
        "Against iterations": curves.charts(done, "iteration", 0),
        "Against path samples": curves.charts(done, "samples", 0),
        "MAPE against training time": curves.charts(done, "seconds", 1),
        "MAPE against path samples": curves.charts(done, "samples", 1),
        "Lamps that were found against training time": curves.charts(done, "seconds", 2),
    }
    firsts = [group[0] for group in by_method(done).values()]
    shown = views.compared(firsts, count, trust) if count else []
    if shown:
        paper.write_crops(out / "crops", shown[0].columns, shown[0].scale)
    sheets = [views.sheet(view) for view in shown]
    for number, sheet in enumerate(sheets):
        write_png(out / f"view_{number:03d}.png", draw(sheet))
    page.write_page(
        out / "index.html",
        f"Comparison on {scene_name(runs)}",
        [f"<code>{html.escape(line)}</code>", html.escape(". ".join(p for p in (budget, _about()) if p) + ".")],
        rows,
        reach,
        curves.charts(done, "seconds", 0),
        further,
        sheets,
        NOTES,
    )


def scene_name(runs: Sequence[Run]) -> str:
    """The scene of the runs, by the settings of the first one that has any."""
    for run in runs:
        data = run.config.get("data") or {}
        if data.get("root") or data.get("scene"):
            return Path(str(data["root"])).name if data.get("root") else str(data["scene"])
    return "an unknown scene"


def machine() -> str:
    """Processor, cores that may be used, and the GPU if there is one."""
    import torch

    cores = usable_cores()
    gpu = f", {torch.cuda.get_device_name(0)}" if torch.cuda.is_available() else ""
    return f"{processor()}, {cores} core{'s' if cores > 1 else ''}{gpu}"


def _about() -> str:
    import torch

    return f"{machine()}, Python {platform.python_version()}, torch {torch.__version__}, {date.today().isoformat()}"
