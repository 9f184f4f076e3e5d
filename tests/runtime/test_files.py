"""Files are written whole or not at all, and every refusal of the system becomes one sentence."""

import os
from pathlib import Path

import pytest
from helpers.small_files import small_files

from neurad.core.errors import InputError
from neurad.runtime import files


@pytest.fixture(autouse=True)
def _here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def test_a_file_that_cannot_be_written_stays_as_it_was_and_appending_adds_all_or_nothing():
    files.write_text("a", "old")
    with small_files(4096), pytest.raises(InputError, match=r"^a: .*ulimit -f"):
        files.write_text("a", "x" * 5000)
    assert Path("a").read_text() == "old"
    assert os.listdir() == ["a"]

    files.append("b", b"1" * 4000)
    with small_files(4096), pytest.raises(InputError, match="ulimit -f"):
        files.append("b", b"2" * 200)
    assert Path("b").read_bytes() == b"1" * 4000


@pytest.mark.parametrize(
    ("path", "why"),
    [
        ("/dev/full", "no space is left"),
        (".", "it is a folder"),
        ("file/x", "is a file, but a folder is needed"),
        ("a" * 253, "its name is too long"),
        ("loop/x", "a circle of symbolic links"),
        ("pipe", "a pipe that nobody reads"),
        ("a\0b", "no file can have this name"),
    ],
)
def test_a_file_that_cannot_be_written_is_found_before(path, why):
    Path("file").touch()
    os.symlink("loop", "loop")
    os.mkfifo("pipe")
    before = sorted(os.listdir())
    for attempt in (files.check_file, lambda name, _: files.write_text(name, "text")):
        with pytest.raises(InputError, match=why):
            attempt(path, "--out")
    assert sorted(os.listdir()) == before


@pytest.mark.parametrize(
    ("path", "why"),
    [
        ("file", "it is a file, but a folder is needed"),
        ("file/x/y", "a part of its path is a file"),
        ("/proc/x", "^--out /proc/x: "),
    ],
)
def test_a_folder_that_cannot_be_used_is_found_before(path, why):
    Path("file").touch()
    with pytest.raises(InputError, match=why):
        files.check_folder(path, "--out")
    files.check_folder("new/folder", "--out")
    assert os.listdir() == ["file"]


def test_too_little_space_is_found_before():
    with small_files(4096):
        files.check_space(Path("new/folder"), 4096, 1, "checkpoints")
    with pytest.raises(InputError, match=r"^new: checkpoints need .* MB, but its disk has .* MB left"):
        files.check_space(Path("new"), 4096, 1 << 50, "checkpoints")
    with small_files(4096), pytest.raises(InputError, match="ulimit -f"):
        files.check_space(Path("new"), 5000, 1, "checkpoints")


def test_a_device_is_written_to_and_a_link_leads_to_what_is_replaced():
    files.check_file(os.devnull)
    files.write_text(os.devnull, "text")
    assert not Path(os.devnull).is_file()

    os.symlink("target", "link")
    files.write_text("link", "text")
    assert Path("link").is_symlink()
    assert Path("target").read_text() == "text"
