"""``neurad bench peer``: seconds to a given albedo error, for ``neurad fit`` and for Mitsuba 3's path replay.

All run on this machine, one after the other, each as a process of its own, on the same photographs, and are scored by
the same code on the same held-out pixels. Seconds count from the start of each process, compilation included and
evaluation left out. Both sides show averages over the fraction of the iterations that the config says
(``optimization.average``); trials below are without. What the peer gets: rays of all views mixed in one batch, pixels
in turn, leave-one-out residuals instead of a second rendering, the relative loss, a Laplacian pyramid over surface
voxels or the networks of ``neurad fit``, Adam with the same decays of its moments (weight decay is ours alone) and a
cosine over the budget.

Tuning of the peer on the built-in patterned kitchen: 60 CPU-seconds on one core each, albedo (roughness) PSNR.
Unless stated a Laplacian pyramid over 128^3, relative to the photograph, learning rate 0.03, roughness a third of it,
Adam (0.9, 0.99), depth 6, roulette from 4. ``neurad fit --config patterns.yaml`` had 29.4 (17.9) in the same way.

=============================================  =======================
pixels x samples of a batch                    grid
=============================================  =======================
1024 x 4                                       22.3 (15.3)
4096 x 4                                       24.0 (16.3)
4096 x 4, rate 0.01                            24.4 (16.6)
4096 x 4, rate 0.1                             19.5 (12.2)
4096 x 4, 256^3                                23.2 (16.3)
4096 x 4, relative to the other samples' mean  12.8 (15.1), diverged
8192 x 2                                       22.9 (16.0)
8192 x 4, rate 0.02                            24.6 (16.5)
16384 x 4                                      24.7 (16.4)
16384 x 4, Adam (0.9, 0.999)                   24.6 (16.4)
16384 x 4, each finer level 0.7 of the rate    22.5 (16.1)
16384 x 4, each 1.4, coarsest 0.015            23.7 (15.7)
16384 x 4, rate 0.06                           23.8 (15.3)
16384 x 4, 96^3                                24.3 (16.0)
16384 x 4, depth 4                             17.5 (16.7), biased
16384 x 4, depth 20, roulette from 3           24.9 (16.0)
8192 x 8                                       25.0 (16.2)
8192 x 8, depth 20, roulette from 3            25.6 (16.1)
same, Adam (0.95, 0.99), rate 0.02             24.9 (16.1)
4096 x 16, depth 20, roulette from 3           26.1 (16.0)
2048 x 32, depth 20, roulette from 3           25.7 (16.1)
=============================================  =======================

=============================================  =======================
networks at the vertices, rate 0.01            network
=============================================  =======================
16384 x 4, 128^3                               22.4 (16.2)
8192 x 4, 64^3                                 23.7 (16.4)
8192 x 4, 64^3, rate 0.02                      23.8 (15.8)
8192 x 8, 64^3, depth 20, roulette from 3      23.9 (16.4)
2048 x 32, 64^3, depth 20, roulette from 3     23.9 (16.2)
=============================================  =======================

Fitted to the true albedo the voxels reach 29.3 (64^3), 34.2 (128^3) and 36.5 dB (256^3), so resolution is no limit
here; in staircase they reach 21.0 dB at 128^3. Tracing the Python code again costs about 25 ms a step of 420, so
freezing it would gain 6 % at most.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from neurad.core.durations import seconds_of
from neurad.core.ranges import Positive, option, violations

PEERS = ("grid", "network")
UNTIL_STOPPED = "30:00:00:00"
"""A fit wants a limit; the timer replaces it."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the benchmark."""
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--scene", help="name of a built-in scene, such as kitchen or patterns")
    source.add_argument("--root", help="scene folder with scene.xml, transforms_*.json, images/ and albedo/")
    parser.add_argument(
        "--budget", type=option(Positive, seconds_of), nargs="+", required=True, metavar="TIME",
        help="length of a run; with several, all run for each and the earliest time counts",
    )  # fmt: skip
    parser.add_argument("--out", type=Path, default=Path("peer"), help="folder to write (default: peer)")
    parser.add_argument(
        "--peers", default=",".join(PEERS), help="grid, network, both with a comma, or none (default: grid,network)"
    )
    parser.add_argument("--config", help="config of ours (default: that of the scene's name, otherwise scene.yaml)")
    parser.add_argument("--without-ours", action="store_true", help="run the peers alone")
    parser.add_argument(
        "--set", action="append", default=[], metavar="[grid.|network.]KEY=VALUE", dest="changes",
        help="change a setting of the peer (resolution, pixels, samples, max_depth, rr_depth, rate, roughness_rate, "
        "beta1, beta2, final, average, epsilon, seed), such as grid.resolution=192",
    )  # fmt: skip


def run(options: argparse.Namespace) -> None:
    """Run all contestants and write ``peer.csv``, ``curves.csv`` and ``curves.png``.

    Raises:
        InputError: a bad option, a missing package or library, or a run that failed.
    """
    from benchmarks.loaded import load_mitsuba
    from neurad.core.errors import InputError
    from neurad.runtime.files import make_folder
    from neurad.runtime.machine import usable_cores

    kinds = [] if options.peers == "none" else [kind.strip() for kind in options.peers.split(",")]
    for kind in kinds:
        if kind not in PEERS:
            raise InputError(f"--peers: {kind or 'nothing'} is unknown, there are {', '.join(PEERS)} and none")
    if not kinds and options.without_ours:
        raise InputError("--peers: none are left to run")
    if options.root is not None and not Path(options.root).is_dir():
        raise InputError(f"--root: there is no folder {options.root}")
    named = options.scene in ("kitchen", "patterns")
    config = options.config or (f"{options.scene}.yaml" if named else "scene.yaml")
    sizes = _sizes(config)
    plans = {kind: _settings(options, kind, sizes) for kind in kinds}
    if kinds:
        load_mitsuba()
    from benchmarks.peer import report

    make_folder(options.out, "--out")
    curves = []
    for budget in sorted(options.budget):
        if not options.without_ours:
            path = _fit(options, config, budget)
            curves.append(report.read_curve("ours", budget, path))
        for kind in kinds:
            path = _peer(options.out, kind, budget, plans[kind])
            curves.append(report.read_curve(f"peer_{kind}", budget, path))
        rows = report.write(options.out, curves, f"{options.scene or Path(options.root).name}, {usable_cores()} cores")
    for curve in curves:
        if not curve.rows:
            print(f"neurad: {curve.contestant} had not even started after {curve.budget:g} s", file=sys.stderr)
    print("\n" + report.text(rows, curves))
    print(f"\nneurad: peer.csv, curves.csv and curves.png are in {options.out}")


def work(job: str) -> None:
    """What a child process does: one run of the peer with the settings in the JSON file ``job``."""
    from neurad.runtime.allocator import imports_kept

    with imports_kept():  # as neurad fit does
        from benchmarks.peer.fit import main
    main(Path(job))


def _sizes(config: str) -> dict[str, Any]:
    """Network sizes, epsilon and average of a config."""
    from omegaconf import OmegaConf

    from neurad.core.errors import InputError
    from neurad.runs.configs import load_config, overlay

    model = overlay(load_config(config), {}).get("model") or {}
    found: dict[str, Any] = {}
    for name in ("albedo", "roughness"):
        sizes: Any = OmegaConf.to_container(model[name]) if name in model else {}
        if sizes.get("kind", "hash") == "dense":
            raise InputError(f"config {config}: model.{name} is a dense grid, but the network peer needs networks")
        found[name] = {key: value for key, value in sizes.items() if key in ("grid", "width", "hidden_layers")}
    for part, name in (("objective", "epsilon"), ("optimization", "average")):
        value = (model.get(part) or {}).get(name)
        if value is not None:
            found[name] = float(value)
    return found


def _settings(options: argparse.Namespace, kind: str, sizes: dict[str, Any]) -> dict[str, Any]:
    """Settings of a peer: the best found, the config's sizes and the user's changes."""
    from benchmarks.peer.fit import BEST, PeerSettings
    from neurad.core.errors import InputError

    source = {"root": options.root and str(Path(options.root).resolve()), "scene": options.scene}
    settings: dict[str, Any] = {**sizes, **BEST[kind], **source}
    names = (
        "resolution", "pixels", "samples", "max_depth", "rr_depth", "rate", "roughness_rate", "beta1", "beta2", "final",
        "average", "epsilon", "seed",
    )  # fmt: skip
    known: dict[str, Any] = {name: getattr(PeerSettings, name) for name in names}
    for change in options.changes:
        key, equals, value = change.partition("=")
        chosen, dot, name = key.rpartition(".")
        if not equals or name not in known or (dot and chosen not in PEERS):
            raise InputError(f"--set {change}: expected KEY=VALUE, KEY one of {', '.join(known)}")
        if dot and chosen != kind:
            continue
        try:
            settings[name] = type(known[name])(value)
        except ValueError as error:
            raise InputError(f"--set {change}: {value} is not a {type(known[name]).__name__}") from error
    for key, text in violations(settings, PeerSettings, "--set"):
        raise InputError(f"{key}: {text}")
    return settings


def _fit(options: argparse.Namespace, config: str, budget: float) -> Path:
    """``neurad fit`` for ``budget`` seconds; returns its ``metrics.csv``."""
    folder = options.out / f"ours_{budget:g}"
    before = set(folder.glob("lightning_logs/version_*"))
    data = ["--data.root", str(Path(options.root).resolve())] if options.root else ["--data.scene", options.scene]
    arguments = [
        "fit", "--config", config, *data, "--trainer.default_root_dir", str(folder),
        "--trainer.max_time", UNTIL_STOPPED,
        "--trainer.callbacks+=TrainingBudget", f"--trainer.callbacks.seconds={budget:g}",
        "--evaluation.fraction", "1000", "--evaluation.spp", "1",
    ]  # fmt: skip
    _process("ours", budget, arguments)
    made = set(folder.glob("lightning_logs/version_*")) - before
    newest: Path = max(made, key=lambda path: path.stat().st_mtime) if made else folder
    return newest / "metrics.csv"


def _peer(out: Path, kind: str, budget: float, settings: dict[str, Any]) -> Path:
    """The peer for ``budget`` seconds; returns its ``metrics.csv``, in a folder that ``neurad compare --run`` takes."""
    from neurad.runtime.files import make_folder, write_text

    folder = out / f"peer_{kind}_{budget:g}"
    make_folder(folder, "--out")
    path, described = folder / "metrics.csv", folder / "settings.json"
    write_text(described, json.dumps({**settings, "kind": kind, "seconds": budget, "out": str(path)}, indent=1) + "\n")
    _process(f"peer {kind}", budget, ["bench", "peer-worker", str(described)])
    return path


def _process(name: str, budget: float, arguments: list[str]) -> None:
    """Run a contestant to its end, its output passed on to stderr."""
    from neurad.core.errors import InputError
    from neurad.runs import child

    print(f"neurad: {name}, {budget:g} s", file=sys.stderr, flush=True)
    done = subprocess.run([*child.NEURAD, *arguments], stdout=sys.stderr, check=False)
    if done.returncode == 130:
        raise KeyboardInterrupt
    if done.returncode != 0:
        raise InputError(f"bench peer: the run of {name} ended with exit code {done.returncode}, see above")
