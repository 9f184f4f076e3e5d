"""Mutations of camera files."""

import json
import re

from helpers.fuzzing.odd import JSON as TOKENS
from helpers.fuzzing.odd import NAMES, holder, pick, places
from helpers.fuzzing.seeds import Files

KEYS = (
    "w", "h", "fl_x", "fl_y", "cx", "cy", "camera_angle_x", "camera_angle_y", "k1", "p2", "frames", "file_path",
    "transform_matrix", "albedo_path", "roughness_path", "relight_path", "aabb_scale", "camera_model", "", "a" * 3000,
)  # fmt: skip
PLACEHOLDER = re.compile(r'"@@raw (\d+)@@"')


def _changes(change):  # a mutation of the parsed document as one of the files
    def changed(files: Files, i: int, j: int, k: int) -> None:
        name = pick(sorted(n for n in files if n.endswith(".json")), i)
        try:
            document = json.loads(files[name])
        except (ValueError, RecursionError):
            return  # an earlier mutation has broken it
        found = list(places(document))
        if not found:
            return
        # Most of a document are the numbers of its matrices: take the depth first.
        depth = pick(sorted({len(place) for place in found}), k)
        document = change(document, pick([place for place in found if len(place) == depth], j), j, k)
        text = PLACEHOLDER.sub(lambda found: pick(TOKENS, int(found[1])), json.dumps(document))
        files[name] = text.encode("utf-8", "surrogatepass")

    changed.__name__ = change.__name__
    return changed


def _raw(number):
    return f"@@raw {number}@@"


@_changes
def json_value(document, place, j, k):
    """An odd value."""
    holder(document, place)[place[-1]] = _raw(j // 7 + k)
    return document


@_changes
def json_drop(document, place, j, k):
    """An entry less."""
    del holder(document, place)[place[-1]]
    return document


@_changes
def json_add(document, place, j, k):
    """An entry more, of a known name or twice."""
    inside = holder(document, place)
    if isinstance(inside, dict):
        inside[pick(KEYS, j)] = _raw(k) if k % 2 else pick(NAMES, k)
    else:
        inside.insert(place[-1], inside[place[-1]])
    return document


@_changes
def json_name(document, place, j, k):
    """The name of a file."""
    frames = document.get("frames") if isinstance(document, dict) else None
    found = [f for f in frames if isinstance(f, dict)] if isinstance(frames, list) else []
    if found:
        pick(found, j)[pick(("file_path", "file_path", "albedo_path", "relight_path"), k)] = pick(NAMES, j // 3 + k)
    return document


@_changes
def json_wrap(document, place, j, k):
    """An entry inside others, or the whole document another one's."""
    inside = holder(document, place)
    value = inside[place[-1]]
    inside[place[-1]] = pick(([value], {"x": value}, [value] * 3, str(value), [[value]]), j)
    return [document] if k % 11 == 0 else document


JSON = {f.__name__: f for f in (json_value, json_drop, json_add, json_name, json_wrap)}
