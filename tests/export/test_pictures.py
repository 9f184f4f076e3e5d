"""What is said of noise: standard errors of means and of squared differences, against their own spread."""

import json
from functools import partial

import numpy as np
import pytest

from neurad.core.scene_records import Camera, View
from neurad.export import pictures
from neurad.export.pictures import BLOCKS, Pictures, change_is_known, drawn, excess, is_known, squared_difference
from neurad.export.report import write_report
from neurad.export.verified import Verified
from neurad.formats.mitsuba import plugin as mitsuba

SHAPE = (24, 24, 3)
PHOTO = np.full(SHAPE, 0.5, np.float32)


def passes(seed, noise, most=8, views=1):
    """A picture that differs from the photograph by 0.1 and has this much noise."""
    rng = np.random.default_rng(seed)
    known = partial(is_known, photo=PHOTO, views=views)
    return drawn(lambda _: PHOTO + 0.1 + noise * rng.standard_normal((*SHAPE[:2], 1)), known, most)


@pytest.mark.parametrize(("apart", "count"), [(0.0005, 2), (0.05, 8)])
def test_pairs_end_when_what_baking_changes_is_known(apart, count):
    """Their shared noise does not count; what goes on with the folder alone keeps its passes."""
    rng = np.random.default_rng(0)

    def pair(_):
        first = PHOTO + 0.1 + 0.2 * rng.standard_normal(SHAPE)
        return np.concatenate((first, first + apart * rng.standard_normal(SHAPE)), -1)

    pairs = drawn(pair, partial(change_is_known, photo=PHOTO, views=1))
    assert len(pairs) == count
    asked = []
    alone = drawn(lambda seed: asked.append(seed) or PHOTO, lambda found: len(found) >= 6, begun=pairs[:2, ..., :3])
    assert asked == [2, 3, 4, 5]
    assert (alone[:2] == pairs[:2, ..., :3]).all()
    assert len(drawn(lambda seed: PHOTO, lambda found: False, begun=pairs[:2, ..., :3])) == 8


def bright(rng):
    """Rare samples, a thousand times as large as their share: noise of mean 0 and deviation 0.4."""
    hits = rng.random((*SHAPE[:2], 1)) < 1e-2
    return 0.4 * (np.where(hits, 10.0, 0.0) - 0.1)


@pytest.mark.parametrize("most", [2, 4, 8])
def test_standard_errors_are_those_of_repeated_pictures(monkeypatch, most):
    """Over 300 repetitions the spread is as stated within 15 % (four sigma), and squares are without bias."""
    monkeypatch.setattr(pictures, "ERROR", 0.0)  # all passes
    shown = Pictures()
    for seed in range(300):
        shown.add(passes(seed, 0.4, most), PHOTO)
    assert shown.passes == [most] * 300
    assert np.std([x.mean() for x in shown.mean]) == pytest.approx(np.mean(shown.error), rel=0.15)
    squares, errors = np.array(shown.squared).T
    assert np.std(squares) == pytest.approx(np.mean(errors), rel=0.2)
    assert abs(squares.mean() - 0.01) < 4 * np.std(squares) / 300**0.5


def test_rare_bright_samples_are_told_from_common_noise():
    """Where noise is a few bright samples, the spread over 300 repetitions is as stated."""
    found = []
    for seed in range(300):
        rng = np.random.default_rng(seed)
        found.append(squared_difference(np.stack([PHOTO + 0.1 + bright(rng) for _ in range(8)]), PHOTO))
    squares, errors = np.array(found).T
    assert abs(squares.mean() - 0.01) < 4 * np.std(squares) / 300**0.5
    assert np.sqrt(np.square(errors).mean()) == pytest.approx(np.std(squares), rel=0.2)


def test_passes_end_when_the_picture_is_known():
    assert len(passes(0, 1e-4)) == 2
    assert len(passes(0, 0.5)) == 8
    assert len(passes(0, 0.5, most=4)) == 4


@pytest.mark.parametrize("views", [4, 16])
def test_of_many_views_all_together_are_known(views):
    every = [passes(seed, 0.05, 32, views) for seed in range(views)]
    assert all(len(found) < 32 for found in every)
    squares, errors = np.array([squared_difference(found, PHOTO) for found in every]).T
    assert np.sqrt(np.square(errors).sum()) <= pictures.SQUARED_ERROR * squares.sum() * 1.02
    assert max(len(found) for found in every) > 2


@pytest.mark.parametrize("most", [2, 8])
def test_pictures_of_one_noise_are_compared_without_it(most):
    """Over 300 repetitions the difference is unbiased, spread as stated, and known far better than either picture."""
    found = []
    for seed in range(300):
        pair = []
        for off, own in ((0.11, 2000), (0.1, 1000)):
            shape = (most, *SHAPE[:2], 1)
            common, alone = (np.random.default_rng([seed, s]).standard_normal(shape) for s in (0, own))
            pair.append(PHOTO + off + 0.4 * common + 0.01 * alone)
        found.append((*excess(*pair, PHOTO), squared_difference(pair[1], PHOTO)[1]))
    off, error, alone = np.array(found).T
    assert abs(off.mean() - (0.11**2 - 0.1**2)) < 4 * off.std() / 300**0.5
    assert off.std() == pytest.approx(error.mean(), rel=0.2)
    assert error.mean() < 0.2 * alone.mean()


@pytest.mark.parametrize(("fine", "left"), [(False, 0.15**2 - 0.1**2), (True, 0.0)])
def test_blocks_show_what_extends_over_them_and_drown_less_in_noise(fine, left):
    """A difference of all pixels is all there, one that changes sign from pixel to pixel is not."""
    rng = np.random.default_rng(0)
    photo = np.full((64, 64, 3), 0.5, np.float32)
    ours, theirs = (photo + 0.1 + 2.0 * rng.standard_normal((8, *photo.shape)) for _ in range(2))
    even = np.indices(photo.shape[:2]).sum(0)[..., None] % 2 == 0
    theirs += np.where(even | (not fine), 0.05, -0.05)
    (whole, error), (blocks, block_error) = (excess(theirs, ours, photo, block) for block in (1, 16))
    assert whole == pytest.approx(0.05**2 if fine else left, abs=4 * error)
    assert blocks == pytest.approx(left, abs=4 * block_error)
    assert block_error < 0.3 * error


def test_what_is_white_does_not_count_and_numbers_of_passes_may_differ():
    photo = PHOTO.copy()
    photo[:12] = 20.0
    shown = np.stack([photo + 0.1] * 4)
    shown[:, :12] += np.random.default_rng(0).normal(0.0, 50.0, (4, 12, *SHAPE[1:]))
    for block in (1, 16):
        assert excess(shown, np.stack([photo] * 4), photo, block)[0] == pytest.approx(0.01, rel=1e-5)
    assert squared_difference(shown, photo)[0] == pytest.approx(0.01, rel=1e-5)

    ours, theirs = (np.stack([PHOTO + off] * k) for off, k in ((0.1, 4), (0.2, 2)))
    assert excess(theirs, ours, PHOTO)[0] == pytest.approx(0.03, rel=1e-5)


# ---- verdicts: a bound is kept or missed by more than noise explains, and what noise leaves open is said


PLAIN = np.full((32, 32, 3), 0.5, np.float32)


def verified(noise, brighter=0.0):
    """Three renderers of one view: the folder by neurad and by Mitsuba, and the fields with the folder's own noise."""
    pose = np.eye(4, dtype=np.float32)
    found = Verified([View("front", Camera(pose, 0.8, 32, 32))], held_out=True, photographs=[PLAIN])
    rng = np.random.default_rng(0)
    ours, theirs = (PLAIN + 0.1 + noise * rng.standard_normal((8, *PLAIN.shape)) for _ in range(2))
    shown = {"baked": ours, "fields": ours, "mitsuba": theirs + brighter}
    for name, passes in shown.items():
        found.pictures[name] = Pictures()
        found.pictures[name].add(passes.astype(np.float32), PLAIN)
        if name != "baked":
            found.excess[name] = [{block: excess(passes, ours, PLAIN, block) for block in BLOCKS}]
    found.judge()
    return found


def states(found):
    said = json.loads(json.dumps(found.as_json()))
    return {entry["what"]: entry["verdict"] for entry in said["bounds"]}


def test_without_noise_all_bounds_are_kept():
    found = verified(1e-4)
    assert set(states(found).values()) == {"kept"}
    assert found.beyond == found.undecided == []


def test_noise_leaves_bounds_open_and_that_is_said(tmp_path):
    found = verified(3.0)
    said = states(found)
    assert said["mitsuba's PSNR less ours by means over 16 x 16 pixels, dB"] == "not decided"
    assert said["picture lost by baking, dB"] == "kept"  # they share their noise
    assert any(text.startswith("mitsuba's PSNR less ours is") for text in found.undecided)
    write_report(found, tmp_path / "report.html", "Zimmer")
    page = (tmp_path / "report.html").read_text()
    assert "noise leaves some open" in page
    assert "Not decided: mitsuba" in page


def test_what_noise_hides_is_decided_by_the_smallest_blocks_and_differences_miss_their_bounds():
    found = verified(1e-4)
    found.excess["mitsuba"] = [{1: (0.0, 1e-3), 4: (1e-5, 1e-5), 16: (0.0, 0.0)}]  # of a squared difference of 0.01
    found.judge()
    (verdict,) = (verdict for verdict in found.verdicts if verdict.name.startswith("mitsuba's PSNR"))
    assert (verdict.name, verdict.state) == ("mitsuba's PSNR less ours by means over 4 x 4 pixels, dB", "kept")
    assert (verdict.value, verdict.error) == found.difference("mitsuba", 4)

    found = verified(1e-3, brighter=0.02)
    assert states(found)["mitsuba: farthest mean of a view less 1"] == "missed"
    assert states(found)["mitsuba's PSNR less ours, dB"] == "missed"
    assert found.difference("mitsuba")[0] == pytest.approx(-20 * np.log10(0.12 / 0.1), abs=0.01)
    assert len(found.beyond) == 2


def test_mitsuba_is_left_out_where_it_would_wait_forever(monkeypatch):
    pytest.importorskip("mitsuba")
    monkeypatch.setattr(mitsuba, "usable_cores", lambda: 2)
    assert mitsuba.no_mitsuba() is None
    monkeypatch.setattr(mitsuba, "usable_cores", lambda: 1)
    assert "single core" in mitsuba.no_mitsuba()


@pytest.mark.parametrize("before", ["scalar_rgb", None])
def test_mitsubas_variant_is_set_again_whatever_happens(monkeypatch, before):
    mi = pytest.importorskip("mitsuba")
    was = mi.variant()
    mi.set_variant("scalar_rgb")
    monkeypatch.setattr(mi, "variant", lambda: before)
    chosen = []

    def fail():
        with mitsuba.mitsuba_as(mitsuba.fastest()) as module:
            chosen.append(module.Float)
            raise ZeroDivisionError

    for reason in (None, "no LLVM"):
        monkeypatch.setattr(mitsuba, "no_llvm", lambda reason=reason: reason)
        with pytest.raises(ZeroDivisionError):
            fail()
        assert mi.Float is float  # of scalar_rgb
    monkeypatch.undo()
    assert chosen[0] is not float
    assert chosen[1] is float
    if was is not None:
        mi.set_variant(was)
