"""``neurad data`` that is killed: its folder is there as a whole or not at all, and the next run makes it."""

import os
import random
import signal
import subprocess
import sys
import time

import pytest
from helpers import layouts

from neurad.cli import main
from neurad.formats.load import load_scene

pytest.importorskip("mitsuba")

KILLS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
HALF_WRITTEN = """
import os, signal, sys
from neurad.formats import import_room
def killed(room, part):
    (part / "transforms.json").write_text("{")
    os.kill(os.getpid(), int(sys.argv[1]))
import_room.write_room = killed
import_room.import_room(import_room.ImportSettings("nerfstudio", import_room.Path("src"), import_room.Path("room")))
"""


@pytest.fixture
def words(tmp_path, monkeypatch):
    """The command, in a working folder with its source."""
    monkeypatch.chdir(tmp_path)
    layouts.write_nerfstudio(tmp_path / "src", layouts.cameras(count=40))
    layouts.write_mesh(tmp_path / "mesh")
    return ["data", "nerfstudio", "src", "--mesh", "mesh/room.obj", "--copy", "--out", "room"]


def left(folder):
    """What a killed run has left beside its source."""
    return sorted(path.name for path in folder.iterdir() if path.name not in ("src", "mesh", "room"))


def is_whole():
    scene = load_scene("room", None, 0)
    assert (len(scene.train), len(scene.meshes)) == (40, 2)
    assert all(os.path.getsize(view.image) == os.path.getsize(f"src/images/{view.name}.exr") for view in scene.train)


@pytest.mark.parametrize("kill", [signal.SIGKILL, signal.SIGTERM])
def test_what_a_killed_run_left_is_removed_by_the_next(words, tmp_path, kill):
    child = subprocess.run([sys.executable, "-c", HALF_WRITTEN, str(int(kill))], check=False)
    assert child.returncode == -kill
    assert len(left(tmp_path)) == 1
    assert not os.path.exists("room")
    main(words)
    assert left(tmp_path) == []
    is_whole()


@pytest.mark.slow
def test_killed_at_20_random_moments(words, tmp_path):
    """By all signals, half of the times while the folder is written; no run in between refuses."""
    dice = random.Random(48)
    command = [sys.executable, "-m", "neurad", *words]
    start = time.monotonic()
    subprocess.run(command, check=True)
    whole = time.monotonic() - start
    kills, written = 0, 0
    while kills < 20:
        if os.path.exists("room"):
            is_whole()
            os.rename("room", f"src/{dice.random()}")  # what is written whole stays
        before = left(tmp_path)
        child = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        if kills % 2:
            while not any(name not in before for name in left(tmp_path)) and child.poll() is None:
                time.sleep(1e-3)
            time.sleep(dice.uniform(0.0, 0.2))
        else:
            time.sleep(dice.uniform(0.0, whole))
        child.send_signal(KILLS[kills % 3])
        said = child.communicate()[1]
        assert child.returncode in (0, 130, *(-kill for kill in KILLS)), said
        kills += child.returncode != 0
        written += bool(left(tmp_path))
    assert written >= 3  # the moments that matter were among them
    if os.path.exists("room"):
        is_whole()
        os.rename("room", "src/whole")
    subprocess.run(command, check=True)
    assert left(tmp_path) == []
    is_whole()
