"""Values that programs stumble over."""

NUMBERS = (
    "nan", "inf", "-inf", "1e39", "-1e39", "1e400", "-1e400", "3e38", "-3e38", "1e-30", "1e-45", "1e15", "1e30",
    "-1", "0", "-0.0", "0.5", "1", "2", "3", "7", "1.0000001", "-0.5", "255", "65504", "65536", "1000000", "0.001",
    "0.02", "0.25", "0.9", "0.999999", "-2", "10", "100", "1e-3", "1e3", "1e6", "1e10", "-1e10", "1e-6", "1e-10",
    "1e-20", "1e12", "1e20", "2147483647", "2147483648", "-2147483648", "-2147483649", "4294967295",
    "9223372036854775807", "9223372036854775808", "18446744073709551616", "1" + "0" * 400, "1" + "0" * 5000,
)  # fmt: skip
"""As text; all but the first three and those with a sign or a point before them are JSON, too."""
WORDS = (
    "", " ", "abc", "0x10", "1_000", "1,5", "1;2", "1 2 3", "0.1, 0.2", "1, 1, 1, 1", "١٢", "1e", "+-1", "--1", "true",
    "false", "null", "None", "~", "*", "$depth", "$nothing", "${x}", "${data.root}", "%s%n", "{x}", "a\nb", "\t", "é",
    "\ud800", "\0", "\u202e", "'", '"', "<", "&", "9" * 300, "a" * 70000,
)  # fmt: skip
NAMES = (
    "", ".", "..", "/", "../../../../etc/passwd", "~", "~nobody/x.exr", "~nosuchuser/x.exr", "$HOME/x.exr",
    "a" * 255 + ".exr", "a" * 256, "a/" * 3000 + "b.exr", "x\0y.exr", "\0", "\ud800.exr", "a\nb.exr", " ", "é.exr",
    "\u202e.exr", "%s%n.exr", "{x}.exr", "http://localhost/x.exr", "file:///etc/passwd", "/dev/null", "/dev/zero",
    "/proc/self/mem", "images", "meshes", "textures", "scene.xml", "transforms_train.json", "meshes/floor.ply",
    "meshes/block.obj", "meshes/binary.ply", "textures/paint.png", "textures/gloss.exr", "textures/tint.hdr",
    "textures/tint.pfm", "images/train_0.exr", "sky.exr", "./images/../images/train_0", "IMAGES/TRAIN_0.EXR",
)  # fmt: skip
JSON = (
    *(number for number in NUMBERS if number not in ("nan", "inf", "-inf")), "NaN", "Infinity", "-Infinity", "true",
    "false", "null", '""', '"abc"', '"1"', '"nan"', '"\\ud800"', '"\\u0000"', "[]", "{}", "[[]]", "[{}]", "[null]",
    "[1, 2, 3]", "[[1, 2], [3]]", '{"": {}}', "[" * 2000 + "]" * 2000, "[" * 100000 + "]" * 100000,
    '{"a":' * 3000 + "1" + "}" * 3000, '"' + "a" * 70000 + '"',
    "[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]", "[[0,0,0,0],[0,0,0,0],[0,0,0,0],[0,0,0,1]]",
    "[[1,0,0,1e30],[0,1,0,0],[0,0,1,0],[0,0,0,1]]", "[[1,0,0,1e300],[0,1,0,0],[0,0,1,0],[0,0,0,1]]",
    "[[1,0,0,5],[0,1,0,5],[0,0,1,5]]", "[[1,0,0,NaN],[0,1,0,0],[0,0,1,0],[0,0,0,1]]",
)  # fmt: skip
"""Tokens that JSON files may hold, the last ones camera poses."""
FLOATS = (
    float("nan"), float("inf"), -float("inf"), 3e38, -3e38, 1e30, 1e20, 1e10, 1e-30, 1e-45, -1.0, 0.0, -0.0, 1.0,
    65504.0, 1e5, 0.5, -0.5, 10.0, 1e15, 1e12, 1e-5, 1e-10, 1e-20, 1000.0,
)  # fmt: skip
"""For files that hold float32."""
INTEGERS = (-1, 0, 1, 2, 3, 4, 7, 255, 65535, 2**31 - 1, -(2**31), 2_000_000_000, -2, 100_000, 1 << 24)
"""For files that hold 32 bits."""


def pick(options, number):
    """One of the options, whatever the number."""
    return options[number % len(options)]


def containers(value, depth=0):
    """All lists and objects in a document, each with how deep it lies."""
    if isinstance(value, dict | list):
        yield depth, value
        for inner in value.values() if isinstance(value, dict) else value:
            yield from containers(inner, depth + 1)


def change(document, where, how, odd, keys):
    """Replace a value of a document by an odd one, add it under one of the keys, take a value away or put it there
    twice. Depths are equally likely: most of a document are the numbers of its matrices.
    """
    levels = {}
    for depth, inside in containers(document):
        levels.setdefault(depth, []).append(inside)
    inside = pick(pick([levels[depth] for depth in sorted(levels)] or [[[0]]], where), where // 7)
    if isinstance(inside, dict):
        key = pick(list(inside) or list(keys), how // 3) if how % 3 else pick(keys, how // 3)
        if how % 7 == 1:
            inside.pop(key, None)
        else:
            inside[key] = odd
    elif inside:
        place = how % len(inside)
        if how % 7 == 1:
            del inside[place]
        elif how % 7 == 2:
            inside.insert(place, inside[place])
        else:
            inside[place] = odd
