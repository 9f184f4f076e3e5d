"""Files that are none, text that is none, and what libraries print."""

import os
import socket
import threading

import pytest

from neurad.core.errors import InputError
from neurad.runtime import memory
from neurad.runtime.reading import exists, folder, listed, quiet, read_bytes, read_json, regular_file


def test_folders(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    os.symlink("loop", "loop")
    assert folder(".", "--x") == tmp_path.resolve()
    for name in ("none", "~nosuchuser/x", "loop", "a" * 300, "a\0b", "\ud800", "/dev/zero"):
        with pytest.raises(InputError, match=r"^--x: ") as caught:
            folder(name, "--x")
        assert len(str(caught.value)) < 300
    assert not exists("none")
    assert not exists("none/none")


def test_only_regular_files_are_opened(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    os.mkfifo("pipe")
    os.symlink("loop", "loop")
    os.symlink("/dev/zero", "zero")
    os.mkdir("folder")
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind("socket")
    said = {
        "pipe": "pipe: it is a named pipe, not a file",
        "loop": "loop: its symbolic links lead in a circle",
        "zero": "zero: it is a device, not a file",
        "folder": "folder: it is a folder, not a file",
        "socket": "socket: it is a socket, not a file",
        "none": "none: there is no such file",
        "folder/none/x": "x: there is no such file",
        "a" * 300: "its name is longer than the file system allows",
        "a\0b": r"a\\x00b: its name has a NUL character",
        "\ud800": r"\\ud800: its name has characters that no file name can have",
    }
    for name, sentence in said.items():
        with pytest.raises(InputError, match=sentence):
            regular_file(name)


def test_what_others_print_while_a_library_is_quiet_is_kept(capfd):
    def read():
        with quiet():
            os.write(1, b"a table\n")
            os.write(2, b"x.exr: (EXR_ERR_BAD_CHUNK_LEADER) noise\nprogress")

    thread = threading.Thread(target=read)
    thread.start()
    thread.join()
    assert capfd.readouterr() == ("a table\n", "progress")


def test_memory_is_said_before_it_is_taken(monkeypatch, capfd):
    assert memory.free_memory() > 0
    monkeypatch.setattr(memory, "free_memory", lambda: 3 << 30)
    memory.reserve("small", 1 << 20, 1 << 20)
    assert capfd.readouterr().err == ""
    memory.reserve("large", 2 << 30, 1_500_000_000)
    memory.reserve("large", 2 << 30, 1_500_000_000)
    assert capfd.readouterr().err == "neurad: large: it takes 1.5 GB of memory\n"
    with pytest.raises(InputError, match=r"huge: reading it takes 4\.29 GB of memory, and 3\.22 GB are free"):
        memory.reserve("huge", 4 << 30, 4 << 30)


def test_json_may_begin_with_a_byte_order_mark_and_has_to_be_utf_8(tmp_path):
    file = tmp_path / "a.json"
    file.write_bytes(b'\xef\xbb\xbf{"a": [1, 2.5]}')
    assert read_json(file) == {"a": [1, 2.5]}
    with pytest.raises(InputError, match="more than 0 MB"):
        read_bytes(file, 3)
    file.write_bytes('"a"'.encode("utf-16"))
    with pytest.raises(InputError, match=r"a\.json: it is not text in UTF-8"):
        read_json(file)


def test_a_long_list_of_names_ends_with_how_many_others():
    assert listed(["a", "b", "c"], 2) == "a, b, c"
    assert listed(["a", "b", "c", "d"], 2) == "a, b and 2 others"
