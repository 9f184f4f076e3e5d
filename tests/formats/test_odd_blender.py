"""Rooms that Blender's side cannot have written: each is read, or refused in one sentence."""

import copy
import json
import math
import random

import numpy as np
import pytest
from helpers.blender_dump import CAMERA, GREY, lamp, room, square, write_dump

from neurad.core.errors import InputError
from neurad.formats.blender.cameras import camera_of
from neurad.formats.blender.lamps import beam_width
from neurad.formats.blender.read import read_blender

ODD = [
    None, True, -1, 0, 3, 1e30, -1e300, float("nan"), float("inf"), "", "x", "../x", "ü\0", [], [1], [1, 2, 3],
    [float("nan")] * 3, [[1, 2], [3]], {}, {"unread": "x"}, {"file": "x.npy"}, 10**400,
]  # fmt: skip


def whole_room():
    """A room with a bit of everything."""
    picture = {"file": "image.npy", "coded": True, "channel": None, "uv": "", "to_uv": np.eye(3).tolist()}
    glow = {"name": "glow", "shader": "EMISSION", "emission": picture, "strength": 2.0}
    rough = {**GREY, "name": "rough", "color": picture, "roughness": {**picture, "coded": False, "channel": 1}}
    kinds = ("AREA", "POINT", "SPOT", "SUN")
    return room(
        objects=[square(), square("a", materials=[1]), square("b", materials=[2])], materials=[GREY, rough, glow],
        lamps=[lamp(kind, name=kind) for kind in kinds], world={"color": [0.1, 0.2, 0.3]}, left_out={"hair": ["x"]},
    )  # fmt: skip


def places(value, path=()):
    """The paths of all values in what JSON describes."""
    yield path
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in items:
        yield from places(inner, (*path, key))


def damaged(rng):
    """The room with one to three values replaced or taken away."""
    described = copy.deepcopy(whole_room())
    for _ in range(rng.randint(1, 3)):
        path = rng.choice([path for path in places(described) if path])
        parent = described
        for key in path[:-1]:
            parent = parent[key]
        if isinstance(parent, dict) and rng.random() < 0.3:
            del parent[path[-1]]
        else:
            parent[path[-1]] = copy.deepcopy(rng.choice(ODD))
    return described


@pytest.mark.parametrize("count", [100, pytest.param(4000, marks=pytest.mark.slow)])
def test_odd_rooms(tmp_path, count):
    rng = random.Random(count)
    write_dump(tmp_path)
    np.save(tmp_path / "image.npy", np.arange(24, dtype=np.uint8).reshape(2, 4, 3))
    (tmp_path / "blender.json").write_text(json.dumps(whole_room()))
    assert len(read_blender(tmp_path, "raum.blend").scene.meshes) > 5
    sentences = []
    for _ in range(count):
        described = damaged(rng)
        (tmp_path / "blender.json").write_text(json.dumps(described))
        try:
            read_blender(tmp_path, "raum.blend")
        except InputError as error:
            sentences.append(str(error))
        except BaseException:
            print(json.dumps(described))
            raise
    assert not [sentence for sentence in sentences if "\n" in sentence or len(sentence) > 600]
    assert len(sentences) > 0.3 * count


# ---- blender's numbers: lenses, and the cones of spots


@pytest.mark.parametrize("blend", [0.0, 0.15, 0.6, 1.0])
@pytest.mark.parametrize("half", [0.1, 0.6, 1.5])
def test_a_spot_has_the_power_of_blenders(half, blend):
    angle = (np.arange(200_000) + 0.5) / 200_000 * half
    solid = np.sin(angle)
    t = (
        np.ones_like(angle)
        if blend == 0
        else np.clip((np.cos(angle) - math.cos(half)) / ((1 - math.cos(half)) * blend), 0, 1)
    )
    cycles = (3 * t**2 - 2 * t**3) * solid
    beam = beam_width(half, blend)
    assert 0.0 <= beam <= half
    ours = np.clip((half - angle) / max(half - beam, 1e-12), 0, 1) * solid
    assert ours.sum() == pytest.approx(cycles.sum(), rel=1e-4)


@pytest.mark.parametrize(
    ("lens", "film", "aspect", "focal", "centre"),
    [
        ({}, [12, 9], (1, 1), (12, 12), (6, 4.5)),
        ({}, [9, 12], (1, 1), (12, 12), (4.5, 6)),  # AUTO is along the longer side
        ({"sensor_fit": "VERTICAL"}, [12, 9], (1, 1), (13.5, 13.5), (6, 4.5)),
        ({"sensor_fit": "HORIZONTAL"}, [9, 12], (1, 1), (9, 9), (4.5, 6)),
        ({"shift_x": 0.1, "shift_y": -0.05}, [12, 9], (1, 1), (12, 12), (4.8, 3.9)),
        ({}, [12, 9], (1, 2), (18, 9), (6, 4.5)),  # 12 x 18 to the eye: along y
        ({"lens": 72.0}, [12, 9], (2, 1), (24, 48), (6, 4.5)),
    ],
)
def test_lenses(lens, film, aspect, focal, centre):
    camera = camera_of({**CAMERA, **lens}, tuple(film), aspect, "x").seen(*film)
    assert (camera.fl_x, camera.fl_y) == pytest.approx(focal)
    assert (camera.cx, camera.cy) == pytest.approx(centre)
