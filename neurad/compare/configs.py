"""The final settings of fits, found in a child process: the parser brings libraries that the parent must not load."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout, suppress
from io import StringIO
from typing import Any

import yaml  # type: ignore[import-untyped]

from neurad.core.errors import InputError
from neurad.runs import child


def resolved_configs(fits: Sequence[Sequence[str]]) -> list[Mapping[str, Any]]:
    """What ``neurad fit ARGUMENTS --print_config`` prints for every entry of ``fits``, from one child.

    Raises:
        InputError: the first complaint, in the words of ``neurad fit``.
    """
    text = json.dumps([list(fit) for fit in fits])
    command = [*child.NEURAD, "compare", f"--resolve={text}"]
    with child.signals_raise():
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise InputError(child.last_message(done.stderr) or f"exit code {done.returncode}")
    trees: list[Mapping[str, Any]] = json.loads(done.stdout)
    return trees


def print_configs(text: str) -> None:
    """Print the final settings of fits as JSON; what the child of :func:`resolved_configs` does.

    Args:
        text: the arguments of every fit, as JSON.

    Raises:
        InputError: the first complaint of the parser.
    """
    from datamodules.scene_data import SceneData
    from neurad.runs import lightning
    from neurad.training.inverse import InverseRenderer

    trees = []
    for arguments in json.loads(text):
        with redirect_stdout(StringIO()) as out, suppress(SystemExit):
            lightning.run("fit", [*arguments, "--print_config"], InverseRenderer, SceneData)
        trees.append(yaml.safe_load(out.getvalue()))
    json.dump(trees, sys.stdout, default=str)
