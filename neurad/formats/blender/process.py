"""Blender, or a Python that has bpy: found and started as a program of its own, never imported here."""

import re
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from neurad.core.errors import InputError
from neurad.runtime.reading import shown

OLDEST = (4, 2)
"""The first version that the programs are written for."""
_ASK = "import bpy; print('bpy', bpy.app.version_string)"
_QUIETLY: Any = {
    "stdin": subprocess.DEVNULL, "capture_output": True, "text": True, "errors": "replace", "check": False,
}  # fmt: skip
_SAID = re.compile(r"^(?:bpy|Blender) (\d+)\.(\d+)\S*.*", re.MULTILINE)


@dataclass(frozen=True)
class Blender:
    """How to start a program in Blender's Python."""

    command: list[str]
    """What stands before the program's path."""
    version: str

    def run(self, program: Path, arguments: Sequence[str]) -> str:
        """Run a program to its end, without the user's add-ons and settings.

        Args:
            arguments: of it; it finds them in ``sys.argv`` behind ``--``.

        Returns:
            The last line that it said, for the sentence if what it should have written is missing: Blender ends well
            even if a program has failed.

        Raises:
            InputError: it cannot be started any more.
        """
        try:
            ended = subprocess.run([*self.command, str(program), "--", *arguments], **_QUIETLY)
        except OSError as error:
            raise InputError(f"--blender: {shown(self.command[0])} cannot be started any more") from error
        lines = [line for text in (ended.stderr, ended.stdout) for line in text.strip().splitlines()[-1:] if line]
        return shown(lines[0].strip()) if lines else "no message"


def find_blender(program: str | None) -> Blender:
    """What ``--blender`` names.

    Args:
        program: a Python that can import bpy, or Blender itself; None for the ``blender`` that a shell would find.

    Raises:
        InputError: it is neither, or older than :data:`OLDEST`.
    """
    if program is None and (program := shutil.which("blender")) is None:
        raise InputError(
            "--blender: there is no blender on the PATH; name Blender's program, or a Python that has the package bpy "
            "(pip install bpy, in an environment of its own)"
        )
    for command, ask in (
        ([program], [program, "-c", _ASK]),
        ([program, "--background", "--factory-startup", "--python"], [program, "--version"]),
    ):
        if found := _SAID.search(_answer(ask)):
            if (int(found[1]), int(found[2])) < OLDEST:
                wanted = ".".join(str(x) for x in OLDEST)
                raise InputError(f"--blender: {shown(program)} is {found[0].strip()}; it has to be {wanted} or newer")
            return Blender(command, found[0].strip().partition(" ")[2])
    raise InputError(f"--blender: {shown(program)} is neither a Python with the package bpy nor Blender")


def _answer(command: list[str]) -> str:
    """What a program prints; nothing if it cannot be started or fails."""
    try:
        ended = subprocess.run(command, **_QUIETLY, timeout=120)
    except (OSError, ValueError, subprocess.TimeoutExpired):
        return ""
    return str(ended.stdout) if ended.returncode == 0 else ""
