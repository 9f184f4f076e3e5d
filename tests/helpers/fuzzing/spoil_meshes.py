"""Mutations of PLY and OBJ files, where something of their form stays."""

import struct

from helpers.fuzzing.odd import FLOATS, INTEGERS, NUMBERS, WORDS, pick
from helpers.fuzzing.seeds import Files, file_of

END = b"end_header\n"
HEADER = (
    b"format binary_big_endian 1.0", b"format ascii 1.0", b"format binary_little_endian 1.0", b"format ascii 9.9",
    b"element vertex 4294967295", b"element vertex -1", b"element vertex 0", b"element vertex 1000000000",
    b"element face 0", b"element face 4294967295", b"element edge 3", b"property double x", b"property uchar x",
    b"property float vertex_color", b"property list uint int vertex_indices",
    b"property list float float vertex_indices", b"property list uchar int nothing",
    b"property list uchar double vertex_indices", b"comment x", b"obj_info", b"property float s",
    b"property float nx", b"property float ny", b"property float nz", b"end_header",
)  # fmt: skip
OBJ_LINES = (
    b"f 1 2", b"f 1", b"f", b"f 1 2 3 4", b"f 1 2 3 4 5 6 7", b"f 0 1 2", b"f -1 -2 -3", b"f -99 1 2", b"f 1 2 99",
    b"f 2000000000 1 2", b"f 1/9/1 2/9/2 3/9/3", b"f 1//9 2//9 3//9", b"f a b c", b"f 1/ 2/ 3/", b"f 1 1 1",
    b"v nan 0 0", b"v 1e39 0 0", b"v 1e400 0 0", b"v 1 2", b"v", b"vt inf inf", b"vn 0 0 0", b"vn nan nan nan",
    b"usemtl x", b"mtllib /dev/zero", b"o", b"g", b"\\", b"v 3e38 -3e38 3e38", b"f 4294967297 2 3",
    b"f 99999999999999999999 1 2",
)  # fmt: skip


def ply_header(files: Files, i: int, j: int, k: int) -> None:
    """Another line in the header, or one less."""
    name = file_of(files, ".ply", i)
    if name is None or END not in files[name]:
        return
    head, _, body = files[name].partition(END)
    lines = head.split(b"\n")
    place = 1 + j % max(len(lines) - 1, 1)
    if k % 4 == 0 and place < len(lines):
        del lines[place]
    elif k % 4 == 1:
        lines.insert(place, pick(HEADER, k // 4))
    elif place < len(lines):
        lines[place] = pick(HEADER, k // 4)
    files[name] = b"\n".join(lines) + END + body


def ply_body(files: Files, i: int, j: int, k: int) -> None:
    """An odd number among the vertices or the faces."""
    name = file_of(files, ".ply", i)
    if name is None or END not in files[name]:
        return
    head, _, body = files[name].partition(END)
    if b"ascii" in head:
        words = body.split(b" ")
        place = j % len(words)
        words[place] = pick(NUMBERS, k).encode() + (
            b"\n" + words[place].partition(b"\n")[2] if b"\n" in words[place] else b""
        )
        body = b" ".join(words)
    elif j % 2 and len(body) > 4:
        at = 4 * (j // 2 % (len(body) // 4))
        body = body[:at] + struct.pack("<f", pick(FLOATS, k)) + body[at + 4 :]
    elif len(body) >= 26:  # the two faces at the end, a count and three indices each
        at = len(body) - 26 + 13 * (j // 2 % 2) + 1 + 4 * (j // 4 % 3)
        body = body[:at] + struct.pack("<i", pick(INTEGERS, k)) + body[at + 4 :]
    files[name] = head + END + body


def obj_line(files: Files, i: int, j: int, k: int) -> None:
    """Another line, or another word in one."""
    name = file_of(files, ".obj", i)
    if name is None:
        return
    lines = files[name].split(b"\n")
    place = j % len(lines)
    if k % 2:
        lines.insert(place, pick(OBJ_LINES, k // 2))
    elif lines[place]:
        words = lines[place].split(b" ")
        words[i // 7 % len(words)] = pick(NUMBERS + WORDS, k // 2).encode("utf-8", "surrogatepass")
        lines[place] = b" ".join(words)
    files[name] = b"\n".join(lines)


MESHES = {f.__name__: f for f in (ply_header, ply_body, obj_line)}
