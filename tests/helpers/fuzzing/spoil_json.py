"""Mutations of camera files."""

import json
import re

from helpers.fuzzing.odd import JSON as TOKENS
from helpers.fuzzing.odd import NAMES, change, pick
from helpers.fuzzing.seeds import Files

KEYS = (
    "w", "h", "fl_x", "fl_y", "cx", "cy", "camera_angle_x", "camera_angle_y", "k1", "p2", "frames", "file_path",
    "transform_matrix", "albedo_path", "roughness_path", "relight_path", "aabb_scale", "camera_model", "", "a" * 3000,
)  # fmt: skip
ODD = (*TOKENS, *map(json.dumps, NAMES))
PLACEHOLDER = re.compile(r'"@@raw (\d+)@@"')


def json_change(files: Files, i: int, j: int, k: int) -> None:
    """An odd value, or the name of a file; an entry less, or more."""
    name = pick(sorted(n for n in files if n.endswith(".json")), i)
    try:
        document = json.loads(files[name])
    except (ValueError, RecursionError):
        return  # an earlier mutation has broken it
    change(document, j, k, f"@@raw {j // 7 + k}@@", KEYS)
    text = PLACEHOLDER.sub(lambda found: pick(ODD, int(found[1])), json.dumps(document))
    files[name] = text.encode("utf-8", "surrogatepass")


JSON = {"json_change": json_change}
