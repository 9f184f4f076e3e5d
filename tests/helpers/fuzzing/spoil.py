"""Every mutation of a scene folder by name, and a scene folder from a recipe."""

import json
import re
from pathlib import Path

from helpers.fuzzing.odd import JSON, NAMES, change, pick
from helpers.fuzzing.seeds import VARIANTS, Files, seed_files
from helpers.fuzzing.spoil_bytes import GENERAL, write_files
from helpers.fuzzing.spoil_images import IMAGES
from helpers.fuzzing.spoil_xml import XML

KEYS = (
    "w", "h", "fl_x", "fl_y", "cx", "cy", "camera_angle_x", "camera_angle_y", "k1", "p2", "frames", "file_path",
    "transform_matrix", "albedo_path", "roughness_path", "relight_path", "aabb_scale", "camera_model", "", "a" * 3000,
)  # fmt: skip
ODD = (*JSON, *map(json.dumps, NAMES))


def json_change(files: Files, i: int, j: int, k: int) -> None:
    """An odd value in a camera file, or the name of a file; an entry less, or more."""
    name = pick(sorted(n for n in files if n.endswith(".json")), i)
    try:
        document = json.loads(files[name])
    except (ValueError, RecursionError):
        return  # an earlier mutation has broken it
    change(document, j, k, "@@odd@@", KEYS)
    text = re.sub('"@@odd@@"', lambda _: pick(ODD, j // 7 + k), json.dumps(document))
    files[name] = text.encode("utf-8", "surrogatepass")


MUTATIONS = {**GENERAL, **XML, **IMAGES, "json_change": json_change}
GROUPS = (
    [*XML, *["xml_number"] * 5, "xml_insert", "xml_insert", "xml_change"],
    list(IMAGES),
    ["json_change"],
    list(GENERAL),
)
"""Their names, those of one kind of file together; some of them more often than others."""


def write_spoilt(folder: Path, variant: int, mutations: list[list]) -> None:
    """Write the scene folder of a recipe.

    Args:
        folder: where; its parent exists.
        variant: of the correct folder to start from.
        mutations: name and three numbers of each.
    """
    files = dict(seed_files(variant % VARIANTS))
    for name, i, j, k in mutations:
        MUTATIONS[name](files, i, j, k)
    folder.mkdir()
    write_files(files, folder)
