"""Mutations of any file: bits, lengths, numbers, tokens, and what kind of thing lies at its path.

Every mutation of a scene folder is a function of its files and three numbers, whatever these are.
"""

import os
import re
import struct
from pathlib import Path

from helpers.fuzzing.odd import FLOATS, INTEGERS, NAMES, NUMBERS, WORDS, pick
from helpers.fuzzing.seeds import Files

KINDS = ("missing", "empty", "folder", "loop", "fifo", "dangling", "forbidden", "null", "zero", "socket", "long link")
"""What may lie where a file is expected."""
TOKEN = re.compile(rb"[^\s,<>=\"\[\]{}:/]+")


def flip(files: Files, i: int, j: int, k: int) -> None:
    """Turn one bit; the beginning of a file, its header, gets as many as all the rest."""
    name = pick(sorted(files), i)
    data = bytearray(files[name])
    if data:
        place = j % (min(len(data), 64) if k % 2 else len(data))
        data[place] ^= 1 << (k // 2 % 8)
        files[name] = bytes(data)


def cut(files: Files, i: int, j: int, k: int) -> None:
    """Leave out the end, or a piece."""
    name = pick(sorted(files), i)
    data = files[name]
    begin = j % (len(data) + 1)
    files[name] = data[:begin] + (data[begin + 1 + k // 2 % 64 :] if k % 2 else b"")


def insert(files: Files, i: int, j: int, k: int) -> None:
    """Put bytes in between, or the file once more."""
    name = pick(sorted(files), i)
    data = files[name]
    begin = j % (len(data) + 1)
    new = (b"\0", b"\xff" * 4, b"\n", b"<", b"{", data[:64], data, bytes(range(256)), b"\xef\xbb\xbf")
    files[name] = data[:begin] + pick(new, k) + data[begin:]


def four(files: Files, i: int, j: int, k: int) -> None:
    """Write an odd number over four bytes; the beginning and the end of a file get as many as all the rest."""
    name = pick(sorted(files), i)
    data = files[name]
    if len(data) >= 4:
        near = j // 3 % min(len(data) - 3, 400)
        place = (near, len(data) - 4 - near, j // 3 % (len(data) - 3))[j % 3]
        odd = struct.pack("<f", pick(FLOATS, k // 2)) if k % 2 else struct.pack("<i", pick(INTEGERS, k // 2))
        files[name] = data[:place] + odd + data[place + 4 :]


def token(files: Files, i: int, j: int, k: int) -> None:
    """Replace a word of a text, or of a header, by an odd one."""
    name = pick(sorted(files), i)
    data = files[name]
    found = list(TOKEN.finditer(data[:4096]))
    if found:
        word = pick(found, j)
        odd = pick(NUMBERS + WORDS + NAMES, k)
        files[name] = data[: word.start()] + odd.encode("utf-8", "surrogatepass") + data[word.end() :]


def line(files: Files, i: int, j: int, k: int) -> None:
    """Leave out a line, write it twice, or exchange it with the next one."""
    name = pick(sorted(files), i)
    lines = files[name].split(b"\n")
    place = j % len(lines)
    if k % 3 == 0:
        del lines[place]
    elif k % 3 == 1:
        lines.insert(place, lines[place])
    else:
        lines[place - 1], lines[place] = lines[place], lines[place - 1]
    files[name] = b"\n".join(lines)


def swap(files: Files, i: int, j: int, k: int) -> None:
    names = sorted(files)
    files[pick(names, i)] = files[pick(names, j)]


def kind(files: Files, i: int, j: int, k: int) -> None:
    """Put something else where a file was; carried out by :func:`write_files`."""
    files[pick(sorted(files), i)] = b"KIND " + pick(KINDS, j).encode()


GENERAL = {f.__name__: f for f in (flip, cut, insert, four, token, line, swap, kind)}


def write_files(files: Files, folder: Path) -> None:
    for name, data in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if data.startswith(b"KIND "):
            _special(path, data[5:].decode(errors="replace"))
        else:
            path.write_bytes(data)


def _special(path: Path, what: str) -> None:
    if what == "empty":
        path.write_bytes(b"")
    elif what == "folder":
        path.mkdir()
    elif what == "fifo":
        os.mkfifo(path)
    elif what == "forbidden":
        path.write_bytes(b"x")
        path.chmod(0)
    elif what == "socket":
        import socket

        before = os.getcwd()
        os.chdir(path.parent)  # the path of a socket must be short
        with socket.socket(socket.AF_UNIX) as made:
            made.bind(path.name)
        os.chdir(before)
    elif what != "missing":
        targets = {"loop": path.name, "dangling": "nothing", "null": "/dev/null", "zero": "/dev/zero"}
        path.symlink_to(targets.get(what, "./" * 1500 + "nothing"))
