"""Error against seconds: when each contestant reached which albedo PSNR, as tables and a picture."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from neurad.runtime.files import replacing
from neurad.runtime.tables import align, read_csv, write_csv

CONTESTANTS = ("ours", "peer_grid", "peer_network")
TARGETS = (18.0, 19.0, 20.0, 22.0, 24.0, 26.0, 28.0, 30.0)
CURVES = ("contestant", "budget", "seconds", "iteration", "albedo_psnr", "roughness_psnr", "not_finite")
HEADER = ("target_db", "ours_seconds", "peer_grid_seconds", "peer_network_seconds", "ratio")


@dataclass(frozen=True)
class Curve:
    """The evaluations of one run."""

    contestant: str
    budget: float
    """Seconds that it was given."""
    rows: list[dict[str, str]]
    """Rows of its CSV file, in order."""

    def points(self, score: str = "albedo_psnr") -> list[tuple[float, float]]:
        """Seconds and score of every evaluation that has it."""
        return [(float(r["seconds"]), float(r[score])) for r in self.rows if r.get(score)]

    def reached(self, target: float) -> float | None:
        """Seconds until albedo PSNR ``target`` dB, linear between two evaluations; None if never."""
        before: tuple[float, float] | None = None
        for seconds, score in self.points():
            if score >= target:
                if before is None:
                    return seconds
                return before[0] + (target - before[1]) / (score - before[1]) * (seconds - before[0])
            before = seconds, score
        return None


def read_curve(contestant: str, budget: float, path: Path) -> Curve:
    """The curve in a ``metrics.csv`` of a fit or of the peer; empty if the run wrote none."""
    return Curve(contestant, budget, read_csv(path)[1])


def table(curves: Sequence[Curve], targets: Iterable[float] = TARGETS) -> list[list[str]]:
    """Rows of ``peer.csv`` under :data:`HEADER`: each contestant's earliest time over all its budgets.

    ``ratio`` is that of the faster peer over ours, and empty where either side did not reach the target.
    """
    rows = []
    for target in targets:
        best: list[float | None] = []
        for name in CONTESTANTS:
            times = [curve.reached(target) for curve in curves if curve.contestant == name]
            best.append(min((t for t in times if t is not None), default=None))
        ours, peers = best[0], [t for t in best[1:] if t is not None]
        ratio = f"{min(peers) / ours:.2f}" if ours and peers else ""
        rows.append([f"{target:g}", *("" if t is None else f"{t:.2f}" for t in best), ratio])
    return rows


def write(folder: Path, curves: Sequence[Curve], title: str) -> list[list[str]]:
    """Write ``peer.csv``, ``curves.csv`` and ``curves.png``; returns the rows of ``peer.csv``."""
    rows = table(curves)
    write_csv(folder / "peer.csv", HEADER, [dict(zip(HEADER, row, strict=True)) for row in rows])
    evaluations = [
        {**row, "contestant": curve.contestant, "budget": f"{curve.budget:g}"} for curve in curves for row in curve.rows
    ]
    write_csv(folder / "curves.csv", CURVES, evaluations)
    _draw(folder / "curves.png", curves, title)
    return rows


def text(rows: Sequence[Sequence[str]], curves: Sequence[Curve]) -> str:
    """The table for the terminal, and where every run ended."""
    lines = align([list(HEADER), *([cell or "-" for cell in row] for row in rows)])
    ends = [["run", "budget", "seconds", "iterations", "albedo PSNR", "roughness PSNR", "not finite"]]
    for curve in curves:
        if curve.rows:
            last = curve.rows[-1]
            keys = ("seconds", "iteration", "albedo_psnr", "roughness_psnr", "not_finite")
            ends.append([curve.contestant, f"{curve.budget:g}", *(last.get(key) or "-" for key in keys)])
    return "\n".join([*lines, "", *align(ends)])


def _draw(path: Path, curves: Sequence[Curve], title: str) -> None:
    """Root mean square error of albedo and roughness against seconds, both axes logarithmic."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

    figure = Figure(figsize=(10, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    colors = {"ours": "tab:blue", "peer_grid": "tab:orange", "peer_network": "tab:green"}
    longest = max((curve.budget for curve in curves), default=0.0)
    for axes, score in zip(figure.subplots(1, 2), ("albedo_psnr", "roughness_psnr"), strict=True):
        for curve in curves:
            if points := curve.points(score):
                axes.plot(
                    [seconds for seconds, _ in points],
                    [10.0 ** (-value / 20.0) for _, value in points],
                    color=colors[curve.contestant],
                    label=curve.contestant.replace("_", " ") if curve.budget == longest else None,
                    alpha=1.0 if curve.budget == longest else 0.5,
                )
        axes.set(xscale="log", yscale="log", xlabel="seconds", ylabel=f"{score.split('_')[0]} RMSE")
        for axis, ticks in ((axes.xaxis, (1.0, 2.0, 5.0)), (axes.yaxis, (1.0, 1.5, 2.0, 3.0, 5.0, 7.0))):
            axis.set_major_locator(LogLocator(subs=ticks))
            axis.set_major_formatter(FormatStrFormatter("%g"))
            axis.set_minor_formatter(NullFormatter())
        axes.grid(visible=True, which="both", alpha=0.3)
        if axes.get_legend_handles_labels()[0]:
            axes.legend()
    figure.suptitle(title)
    with replacing(path) as part:
        figure.savefig(part, dpi=120, format="png")
