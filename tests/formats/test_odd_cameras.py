"""Odd camera files of every layout: they are read, or end with one sentence; what is read can be computed with."""

import json
import math
import shutil

import numpy as np
import pytest
import torch
from helpers import layouts
from helpers.fuzzing.odd import change, pick
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from neurad.core.camera import Cameras, camera_rays
from neurad.core.errors import InputError
from neurad.formats.import_room import SOURCES

ODD = (
    None, True, 0, -1, 1, 2**70, -0.0, 1e-300, 1e300, -1e300, math.nan, math.inf, -math.inf, 0.5, 1e-9, 3.2, "", "1",
    "a", "../a", "/", "\0", "ä b", [], {}, [[]], [1, 2, 3], [[1, 0, 0, 0]] * 3, [[0] * 4] * 4, [[math.nan] * 4] * 4,
    "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "PINHOLE", 1000000, 8, "images/frame_00001.exr",
    ["images/frame_00001.exr"],
)  # fmt: skip
KEYS = (
    "k1", "k2", "k3", "k4", "k5", "p1", "p2", "cx", "fl_x", "fl_y", "camera_angle_x", "camera_angle_y", "camera_model",
    "w", "h", "applied_transform", "applied_scale", "mask_path", "train_filenames", "is_fisheye", "frames", "file_path",
    "transform_matrix", "width", "height", "fx", "t_00", "t_23",
)  # fmt: skip
LAYOUTS = {
    "nerfstudio": ("nerfstudio", lambda f: layouts.write_nerfstudio(f, layouts.cameras("opencv", 2)), "*.json"),
    "colmap text": ("colmap", lambda f: layouts.write_colmap(f, layouts.cameras("opencv", 2), False), "*.txt"),
    "colmap binary": ("colmap", lambda f: layouts.write_colmap(f, layouts.cameras("fisheye", 2), True), "*.bin"),
    "polycam": ("polycam", lambda f: layouts.write_polycam(f, layouts.cameras("off-centre", 2)), "*.json"),
    "fipt rendered": (
        "fipt", lambda f: layouts.write_fipt_rendered(f, layouts.one_angle(layouts.cameras(count=3)), 1),
        "transforms.json"),
    "fipt photographed": ("fipt", lambda f: layouts.write_fipt_photographed(f, layouts.cameras(count=2)), "*.txt"),
}  # fmt: skip
CHANGES = st.lists(st.tuples(*[st.integers(0, 2**31)] * 4), min_size=1, max_size=3)


def change_json(text, where, what, how):
    """The document with a value replaced, added, or taken away."""
    try:
        document = json.loads(text)
    except ValueError:
        return text
    change(document, where, how, pick(ODD, what), KEYS)
    return json.dumps(document)


def change_text(text, where, what, how):
    """The text with a word replaced, added, or taken away."""
    lines = text.split("\n")
    index = where % len(lines)
    words = lines[index].split(" ")
    word = str(pick(ODD, what))
    if how % 5 == 0:
        words.append(word)
    elif how % 5 == 1:
        words.pop(how % len(words))
    else:
        words[how % len(words)] = word
    lines[index] = " ".join(words)
    return "\n".join(lines)


def change_bytes(data, where, what, how):
    """The bytes with some of them overwritten, added, or cut off."""
    place = where % max(len(data), 1)
    new = (
        np.float64(pick([x for x in ODD if isinstance(x, float)], what)).tobytes() if what % 2 else bytes([what % 256])
    )
    if how % 5 == 0:
        return data[:place]
    if how % 5 == 1:
        return data[:place] + new + data[place:]
    return data[:place] + new + data[place + len(new) :]


def spoil(folder, pattern, changes):
    for file, where, what, how in changes:
        path = pick(sorted(folder.rglob(pattern)), file)
        if pattern == "*.bin":
            path.write_bytes(change_bytes(path.read_bytes(), where, what, how))
        else:
            changed = change_json if path.suffix == ".json" else change_text
            path.write_text(changed(path.read_text(), where, what, how))


def look(kind, folder):
    """Read a source; whether it could be read."""
    try:
        views = SOURCES[kind][0](folder, None)
    except InputError:
        return False
    for view in views.train + views.test:
        size = torch.tensor([view.camera.width, view.camera.height], dtype=torch.float64)
        rays = camera_rays(view.camera, torch.rand(50, 2, dtype=torch.float64) * size)
        assert rays.d.isfinite().all()
        assert rays.o.isfinite().all()
    Cameras.of([view.camera for view in views.train], "cpu")
    return True


@pytest.mark.parametrize("count", [60, pytest.param(600, marks=pytest.mark.slow)])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_odd_files(layout, count, tmp_path):
    kind, write, pattern = LAYOUTS[layout]
    whole = write(tmp_path / "whole")
    ends = []

    @settings(max_examples=count, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
    @given(CHANGES)
    def one(changes):
        folder = tmp_path / "spoilt"
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(whole, folder)
        spoil(folder, pattern, changes)
        ends.append(look(kind, folder))

    one()
    assert look(kind, whole)
    assert any(ends), "all cases were refused, which shows little of what accepted ones do"
    assert not all(ends)
