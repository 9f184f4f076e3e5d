"""Blender's numbers: lenses, and the cones of spots."""

import math

import numpy as np
import pytest
from helpers.blender_dump import CAMERA

from neurad.formats.blender.cameras_and_lamps import beam_width, camera_of


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
