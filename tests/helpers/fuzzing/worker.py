"""The process that carries out recipes, one after the other, and what they mean.

What is printed meanwhile goes to the case's folder.
"""

import faulthandler
import os
import re
import resource
import signal
import sys
import traceback
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import torch

import neurad
from helpers.fuzzing.read_scene import finite, read_scene
from helpers.fuzzing.spoil_commands import TINY, write_settings, write_verb
from helpers.fuzzing.spoil_runs import write_run
from helpers.fuzzing.spoil_scenes import write_spoilt
from helpers.one_parser import share_parsers
from neurad import cli
from neurad.core.errors import InputError
from neurad.images.image_io import read_exr

MEMORY = 10 << 30
"""Bytes of address space: what asks for more is told no, as on a small machine."""
PREFIX = "neurad: error: "
SHORT, LONG = 25, 3500
"""Characters of an error message, more and fewer."""


def _scene(recipe: dict, folder: Path) -> None:
    write_spoilt(folder / "scene", recipe["variant"], recipe["mutations"])
    read_scene(folder / "scene")


def _fit_scene(recipe: dict, folder: Path) -> None:
    write_spoilt(folder / "scene", recipe["variant"], recipe["mutations"])
    (folder / "tiny.yaml").write_text(TINY)
    cli.main(["fit", "--config", "tiny.yaml", "--data.root", "scene"])


def _checkpoint(recipe: dict, folder: Path) -> None:
    run = neurad.load(write_run(recipe, folder))
    view = (run.scene.test or run.scene.train)[0]
    surface = run.surface(view)
    finite("recovered materials", *(run.map(name, surface) for name in run.maps))
    finite("a picture", run.render(view, spp=1))


def _fit_checkpoint(recipe: dict, folder: Path) -> None:
    path = write_run(recipe, folder)
    verb = ("fit", "fit", "validate", "test", "predict")[recipe["variant"] % 5]
    more = ["--trainer.max_steps", "4"] if verb == "fit" else []
    cli.main([verb, "--ckpt_path", "last" if recipe["variant"] % 2 else str(path), *more])


def _crash(recipe: dict, folder: Path) -> None:
    """What a library might do; to see that it is noticed."""
    if recipe["variant"]:
        os.kill(os.getpid(), signal.SIGSEGV)
    raise ValueError("planted")


READ = {
    "crash": _crash,
    "scene": _scene,
    "settings": lambda recipe, folder: cli.main(write_settings(recipe, folder)),
    "verb": lambda recipe, folder: cli.main(write_verb(recipe, folder)),
    "checkpoint": _checkpoint,
}
"""What is read, by kind of case: of commands, what they do before they run."""
WHOLE = {**READ, "scene": _fit_scene, "checkpoint": _fit_checkpoint}
"""Whole commands."""


def _end_before_they_run() -> None:
    """Let commands of this process end before they run."""
    from neurad.runs.lightning import NeuradCLI  # once the command line is prepared

    share_parsers()
    NeuradCLI._run_subcommand = lambda self, subcommand: None
    for verb, (load, text) in list(cli.OWN_VERBS.items()):
        module = load()
        module.run = lambda options: None
        cli.OWN_VERBS[verb] = (lambda module=module: module), text


def _judge_end(code: int, folder: Path) -> dict:
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
    own = re.findall(r'File ".*/(?:neurad|datamodules)/.*?(\w+)\.py", line \d+, in (\S+)', printed)
    kinds = re.findall(r"^([\w.]*Error)\b", printed, re.M)
    return f"{kinds[-1] if kinds else '?'} in " + " < ".join(f"{file}.{name}" for file, name in reversed(own[-2:]))


def _finite_output(folder: Path) -> dict | None:
    """What a successful command has written that is no number; None where everything is."""
    for path in sorted(path for path in folder.glob("lightning_logs/*/metrics.csv") if path.is_file()):
        _, _, rows = path.read_text(errors="replace").partition("\n")
        if found := re.search(r"^(.*,)?\s*nan\s*(,.*)?$", rows, re.M | re.I):
            return {"end": "silent", "where": "NaN in metrics.csv", "text": f"{path}: {found[0]}"}
    for path in sorted(folder.glob("lightning_logs/*/checkpoints/last.ckpt")):
        state = torch.load(path, weights_only=True)["state_dict"]
        if bad := [n for n, w in state.items() if w.is_floating_point() and not torch.isfinite(w).all()]:
            return {"end": "silent", "where": "NaN in last.ckpt", "text": f"{path}: {bad[0]}"}
    for path in sorted((*folder.glob("lightning_logs/*/images/**/*.exr"), *folder.glob("out/**/*.exr"))):
        if not np.isfinite(read_exr(path)).all():
            return {"end": "silent", "where": "NaN in a picture", "text": str(path)}
    return None


def main(mode: str, pipe: Connection) -> None:
    """Answer recipes with their folders; where these are of ``reading``, commands end before they run."""
    os.setsid()
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    cli._prepare()
    if mode == "reading":
        _end_before_they_run()
    cases, environment = READ if mode == "reading" else WHOLE, dict(os.environ)
    pipe.send({"end": "ready"})
    while True:
        try:
            recipe, folder = pipe.recv()
        except EOFError:
            return
        _redirect(folder)
        os.chdir(folder)
        os.environ.clear()  # of what a case has left there
        os.environ.update(environment)
        try:
            answer = _judge_end(_attempted(cases[recipe["kind"]], recipe, folder), folder)
        except AssertionError as error:
            answer = {"end": "silent", "where": str(error), "text": str(error)}
        if (folder / "executed").exists():  # what code in configs and checkpoints would make
            answer = {"end": "executed", "where": recipe["kind"], "text": ""}
        os.chdir("/")
        pipe.send(answer)


def _redirect(folder: Path) -> None:
    """What is printed from here on goes to the files ``stdout`` and ``stderr`` of the folder."""
    for number, name in ((1, "stdout"), (2, "stderr")):
        descriptor = os.open(folder / name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
        os.dup2(descriptor, number)
        os.close(descriptor)
    faulthandler.enable(2)


def _attempted(function, recipe: dict, folder: Path) -> int:
    """The exit code of a program that does this; what it says is printed."""
    code: object = 0
    try:
        function(recipe, folder)
    except InputError as error:
        code = 2
        print(f"neurad: error: {' '.join(str(error).split())}", file=sys.stderr)
    except SystemExit as leaving:
        code = leaving.code
    except AssertionError:
        raise
    except BaseException:
        code = 1
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
    return code if isinstance(code, int) else int(code is not None)
