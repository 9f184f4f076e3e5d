"""``neurad data`` that is killed: its folder is there as a whole or not at all, and the next run makes it."""

import os
import signal
import subprocess
import sys

import pytest
from helpers import layouts

from neurad.cli import main
from neurad.formats.load import load_scene

pytest.importorskip("mitsuba")

HALF_WRITTEN = """
import os, signal, sys
from neurad.formats import import_room
def killed(room, part):
    (part / "transforms.json").write_text("{")
    os.kill(os.getpid(), int(sys.argv[1]))
import_room.write_room = killed
import_room.import_room(import_room.ImportSettings("nerfstudio", import_room.Path("src"), import_room.Path("room")))
"""


def left(folder):
    """What a killed run has left beside its source."""
    return sorted(path.name for path in folder.iterdir() if path.name not in ("src", "mesh", "room"))


@pytest.mark.parametrize("kill", [signal.SIGKILL, signal.SIGTERM])
def test_what_a_killed_run_left_is_removed_by_the_next(place, kill):
    layouts.write_nerfstudio(place / "src", layouts.cameras(count=40))
    layouts.write_mesh(place / "mesh")
    child = subprocess.run([sys.executable, "-c", HALF_WRITTEN, str(int(kill))], check=False)
    assert child.returncode == -kill
    assert len(left(place)) == 1
    assert not os.path.exists("room")
    main(["data", "nerfstudio", "src", "--mesh", "mesh/room.obj", "--copy", "--out", "room"])
    assert left(place) == []
    scene = load_scene("room", None, 0)
    assert (len(scene.train), len(scene.meshes)) == (40, 2)
    assert all(os.path.getsize(view.image) == os.path.getsize(f"src/images/{view.name}.exr") for view in scene.train)
