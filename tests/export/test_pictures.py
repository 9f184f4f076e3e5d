"""What is said of noise: standard errors of means and of squared differences, against their own spread."""

import numpy as np
import pytest

from neurad.export import pictures
from neurad.export.pictures import Pictures

SHAPE = (24, 24, 3)


def made(seed, photo, noise, most=8):
    """A picture that differs from ``photo`` by 0.1 and has this much noise."""
    rng = np.random.default_rng(seed)
    shown = Pictures()
    shown.add(lambda _: photo + 0.1 + noise * rng.standard_normal((*SHAPE[:2], 1)), photo, most)
    return shown


def test_standard_errors_are_those_of_repeated_pictures(monkeypatch):
    """Over 300 repetitions the spread is as stated within 15 % (four sigma), and squares are without bias."""
    monkeypatch.setattr(pictures, "ERROR", 0.0)  # all passes
    photo = np.full(SHAPE, 0.5, np.float32)
    found = [made(seed, photo, 0.4) for seed in range(300)]
    assert all(p.passes == [8] for p in found)
    means, squares = (np.array(x) for x in zip(*((p.mean[0].mean(), p.squared[0]) for p in found), strict=True))
    assert np.std(means) == pytest.approx(np.mean([p.error[0] for p in found]), rel=0.15)
    assert np.std(squares) == pytest.approx(np.mean([p.squared_error[0] for p in found]), rel=0.2)
    assert abs(squares.mean() - 0.01) < 4 * np.std(squares) / 300**0.5


def test_passes_end_when_the_picture_is_known():
    photo = np.full(SHAPE, 0.5, np.float32)
    assert made(0, photo, 1e-4).passes == [2]
    assert made(0, photo, 0.5).passes == [8]
    assert made(0, photo, 0.5, most=4).passes == [4]


def test_pictures_of_one_noise_are_compared_without_it(monkeypatch):
    """Over 300 repetitions the difference is unbiased, spread as stated, and known far better than either picture."""
    monkeypatch.setattr(pictures, "ERROR", 0.0)
    photo = np.full(SHAPE, 0.5, np.float32)
    found = []
    for seed in range(300):
        ours, theirs = Pictures(), Pictures()
        for shown, off, own in ((ours, 0.1, 1000), (theirs, 0.11, 2000)):
            common, alone = (np.random.default_rng([seed, s]) for s in (0, own))

            def draw(_, off=off, common=common, alone=alone):
                noise = 0.4 * common.standard_normal((*SHAPE[:2], 1)) + 0.01 * alone.standard_normal((*SHAPE[:2], 1))
                return photo + off + noise

            shown.add(draw, photo)
        found.append((*theirs.farther(ours, 0), ours.squared_error[0]))
    off, error, alone = np.array(found).T
    assert abs(off.mean() - (0.11**2 - 0.1**2)) < 4 * off.std() / 300**0.5
    assert off.std() == pytest.approx(error.mean(), rel=0.2)
    assert error.mean() < 0.2 * alone.mean()
