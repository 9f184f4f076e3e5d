"""A folder is there as a whole or not at all, whatever ends the process that writes it."""

import json
import os
import subprocess
import sys

import pytest

from neurad.core.errors import InputError
from neurad.export.folder import MANIFEST, check_out, check_sources, written_beside

WRITES = """
import sys, time
from pathlib import Path
from neurad.export.folder import written_beside
with written_beside(Path(sys.argv[1])) as stage:
    (stage / "half").write_text("x")
    print("written", flush=True)
    time.sleep(60)
"""


def parts(folder):
    return sorted(p.name for p in folder.iterdir() if p.name.startswith("."))


def manifest(folder):
    (folder / MANIFEST).write_text(json.dumps({"base_color_for": "blender"}))


@pytest.fixture
def writer(tmp_path):
    """Another process that is writing ``room``."""
    out = tmp_path / "Zimmer mit Tür"
    child = subprocess.Popen([sys.executable, "-c", WRITES, str(out)], stdout=subprocess.PIPE, text=True)
    assert child.stdout.readline() == "written\n"
    yield child, out
    child.kill()
    child.wait()


def test_what_another_process_is_writing_stays(writer):
    _, out = writer
    before = parts(out.parent)
    with written_beside(out) as stage:
        manifest(stage)
    assert parts(out.parent) == before
    assert (out.parent / before[0] / "half").is_file()


def test_what_was_replaced_is_put_back_after_a_kill_between_two_moves(tmp_path):
    out, moved = tmp_path / "room", tmp_path / ".room.abcdefgh.part/replaced"
    moved.mkdir(parents=True)
    manifest(moved)
    (moved / "kept").touch()
    with pytest.raises(InputError, match="no space is left"), written_beside(out):
        raise OSError(28, "No space left on device", str(out / "x"))
    assert (out / "kept").is_file()
    assert parts(tmp_path) == []


def test_what_stays_until_the_new_folder_is_whole(tmp_path):
    out = tmp_path / "room"
    for name in ("first", "second"):
        with written_beside(out) as stage:
            manifest(stage)
            (stage / name).touch()
            assert not (out / name).exists()
            assert name == "first" or (out / "first").exists()
    assert sorted(p.name for p in out.iterdir()) == [MANIFEST, "second"]
    assert parts(tmp_path) == []


def test_a_link_is_followed_and_kept(tmp_path):
    (tmp_path / "disk").mkdir()
    link = tmp_path / "room"
    link.symlink_to(tmp_path / "disk/room")
    check_out(link, overwrite=False)
    with written_beside(link) as stage:
        manifest(stage)
    assert link.is_symlink()
    assert (tmp_path / "disk/room" / MANIFEST).is_file()
    with pytest.raises(InputError, match="add --overwrite"):
        check_out(link, overwrite=False)
    check_out(link, overwrite=True)


@pytest.mark.parametrize("content", [None, "", "[]", "{}", '{"meshes": []}', "\x00"])
def test_only_exports_are_overwritten(tmp_path, content):
    out = tmp_path / "room"
    out.mkdir()
    (out / "precious").touch()
    if content is not None:
        (out / MANIFEST).write_text(content)
    with pytest.raises(InputError, match="is no folder of an earlier export, so --overwrite does not replace it"):
        check_out(out, overwrite=True)
    assert (out / "precious").exists()
    assert parts(tmp_path) == []


def test_a_folder_is_not_replaced_by_what_is_read_from_it(tmp_path):
    out, elsewhere = tmp_path / "room", tmp_path / "photo.exr"
    (out / "images").mkdir(parents=True)
    elsewhere.touch()
    os.symlink(elsewhere, out / "images/a.exr")
    (tmp_path / "link.exr").symlink_to(out / "images/b.exr")
    check_sources(out, [elsewhere, tmp_path / "rooms/b.exr"])
    for source in (out / "images/a.exr", tmp_path / "link.exr"):
        with pytest.raises(InputError, match="which the run needs; export to another folder"):
            check_sources(out, [source])


@pytest.mark.parametrize("overwrite", [False, True])
def test_what_has_come_to_the_place_meanwhile_stays(tmp_path, overwrite):
    """An export takes minutes; another one, or a folder of one's own, may be there by then."""
    out = tmp_path / "room"

    def exported():
        with written_beside(out, overwrite) as stage:
            manifest(stage)
            out.mkdir()
            (out / "mine.txt").write_text("x")

    with pytest.raises(InputError, match="is no folder of an earlier export" if overwrite else "is there already"):
        exported()
    assert (out / "mine.txt").is_file()
    assert parts(tmp_path) == []
