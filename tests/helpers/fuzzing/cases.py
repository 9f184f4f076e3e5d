"""What recipes mean: cases that are read, and whole commands."""

import math
import os
import signal
from pathlib import Path

from helpers.fuzzing.read_scene import finite, read_scene
from helpers.fuzzing.spoil import write_spoilt
from helpers.fuzzing.spoil_runs import write_run
from helpers.fuzzing.spoil_settings import TINY, write_settings
from helpers.fuzzing.spoil_verbs import arguments
from helpers.one_parser import share_parsers
from neurad import cli
from neurad.cli import main

PREFIX = "neurad: error: "
SHORT, LONG = 25, 3500
"""Characters of an error message, more and fewer."""


def _scene(recipe: dict, folder: Path) -> None:
    write_spoilt(folder / "scene", recipe["variant"], recipe["mutations"])
    read_scene(folder / "scene")


def _fit_scene(recipe: dict, folder: Path) -> None:
    write_spoilt(folder / "scene", recipe["variant"], recipe["mutations"])
    (folder / "tiny.yaml").write_text(TINY)
    main(["fit", "--config", "tiny.yaml", "--data.root", "scene"])


def _settings(recipe: dict, folder: Path) -> None:
    main(write_settings(recipe, folder))


def _verb(recipe: dict, folder: Path) -> None:
    main(arguments(recipe, folder))


def _checkpoint(recipe: dict, folder: Path) -> None:
    import neurad

    run = neurad.load(write_run(recipe, folder))
    view = (run.scene.test or run.scene.train)[0]
    surface = run.surface(view)
    finite("recovered materials", *(run.map(name, surface) for name in run.maps))
    finite("a picture", run.render(view, spp=1))


def _fit_checkpoint(recipe: dict, folder: Path) -> None:
    path = write_run(recipe, folder)
    verb = ("fit", "fit", "validate", "test", "predict")[recipe["variant"] % 5]
    more = ["--trainer.max_steps", "4"] if verb == "fit" else []
    main([verb, "--ckpt_path", "last" if recipe["variant"] % 2 else str(path), *more])


def _crash(recipe: dict, folder: Path) -> None:
    """What a library might do; to see that it is noticed."""
    if recipe["variant"]:
        os.kill(os.getpid(), signal.SIGSEGV)
    raise ValueError("planted")


READ = {"crash": _crash, "scene": _scene, "settings": _settings, "verb": _verb, "checkpoint": _checkpoint}
"""What is read, by kind of case: of commands, what they do before they run."""
WHOLE = {**READ, "scene": _fit_scene, "checkpoint": _fit_checkpoint}
"""Whole commands."""


def end_before_they_run() -> None:
    """Let commands of this process end before they run."""
    from neurad.runs.lightning import NeuradCLI

    share_parsers()
    NeuradCLI._run_subcommand = lambda self, subcommand: None
    for verb, (load, text) in list(cli.OWN_VERBS.items()):
        module = load()
        module.run = lambda options: None
        cli.OWN_VERBS[verb] = (lambda module=module: module), text


def judge_end(code: int, folder: Path) -> dict:
    """Whether a command ended as it may: with 0 and finite numbers, or with 2 and one sentence."""
    printed = (folder / "stderr").read_text(errors="replace")
    lines = [line for line in printed.splitlines() if line.strip()]
    if code < 0:
        return {"end": "crash", "where": f"signal {-code}", "text": printed[-6000:]}
    if "Traceback (most recent call last)" in printed:
        return {"end": "traceback", "where": _place(printed), "text": printed[-6000:]}
    if code == 0:
        return _finite_output(folder) or {"end": "done"}
    said = [line for line in lines if line.startswith(PREFIX)]
    one = len(said) == 1 and lines[-1] == said[0] and said[0].isprintable()
    if code != 2 or not one or not SHORT < len(said[0]) < LONG:
        return {"end": "no sentence", "where": f"exit code {code}, {len(said)} sentences", "text": printed[-6000:]}
    if other := [line for line in lines if not line.startswith("neurad: ")]:
        return {"end": "chatter", "where": other[0][:60], "text": printed[-6000:]}
    return {"end": "sentence", "text": said[0].removeprefix(PREFIX)}


def _place(printed: str) -> str:
    """Where a printed traceback was raised."""
    lines = printed.splitlines()
    frames = [line.split(", in ") for line in lines if line.startswith('  File "') and ", in " in line]
    own = [
        f"{Path(f[0].split(chr(34))[1]).stem}.{f[1]}" for f in frames if "/neurad/" in f[0] or "/datamodules/" in f[0]
    ]
    kinds = [
        line.split(":")[0]
        for line in lines
        if line and not line[0].isspace() and ":" in line and "Error" in line.split(":")[0]
    ]
    return f"{kinds[-1] if kinds else '?'} in " + " < ".join(reversed(own[-2:]))


def _finite_output(folder: Path) -> dict | None:
    """What a successful command has written that is no number; None where everything is."""
    import numpy as np
    import torch

    from neurad.images.image_io import read_exr

    for path in sorted(path for path in folder.glob("lightning_logs/*/metrics.csv") if path.is_file()):
        rows = [line.split(",") for line in path.read_text(errors="replace").splitlines()]
        for row in rows[1:]:
            for name, cell in zip(rows[0], row, strict=False):
                if _is_nan(cell):
                    return {"end": "silent", "where": "NaN in metrics.csv", "text": f"{path}: {name} is {cell}"}
    for path in sorted(folder.glob("lightning_logs/*/checkpoints/last.ckpt")):
        state = torch.load(path, weights_only=True)["state_dict"]
        if bad := [n for n, w in state.items() if w.is_floating_point() and not torch.isfinite(w).all()]:
            return {"end": "silent", "where": "NaN in last.ckpt", "text": f"{path}: {bad[0]}"}
    for path in sorted((*folder.glob("lightning_logs/*/images/**/*.exr"), *folder.glob("out/**/*.exr"))):
        if not np.isfinite(read_exr(path)).all():
            return {"end": "silent", "where": "NaN in a picture", "text": str(path)}
    return None


def _is_nan(cell: str) -> bool:
    try:
        return math.isnan(float(cell))
    except ValueError:
        return False
