"""Verdicts: a bound is kept or missed by more than noise explains, and what noise leaves open is said."""

import json

import numpy as np
import pytest

from neurad.core.records import Camera, View
from neurad.export.pictures import BLOCKS, Pictures, excess
from neurad.export.report import write_report
from neurad.export.verified import Verdict, Verified
from neurad.formats.mitsuba import plugin as mitsuba

PHOTO = np.full((32, 32, 3), 0.5, np.float32)


@pytest.mark.parametrize(
    ("value", "error", "signed", "state"),
    [
        (0.05, 0.0, True, "kept"),
        (0.1001, 0.0, True, "missed"),
        (0.0, 0.049, True, "kept"),
        (0.0, 0.051, True, "not decided"),
        (0.3, 0.08, True, "not decided"),
        (0.3, 0.06, True, "missed"),
        (-5.0, 0.1, True, "kept"),
        (-5.0, 0.1, False, "missed"),
        (-0.05, 0.01, False, "kept"),
    ],
)
def test_what_is_near_its_bound_is_not_decided(value, error, signed, state):
    assert Verdict("w", value, error, 0.1, "t", signed).state == state


def verified(noise, brighter=0.0):
    """Three renderers of one view: the folder by neurad and by Mitsuba, and the fields with the folder's own noise."""
    pose = np.eye(4, dtype=np.float32)
    found = Verified([View("front", Camera(pose, 0.8, 32, 32))], held_out=True, photographs=[PHOTO])
    rng = np.random.default_rng(0)
    ours, theirs = (PHOTO + 0.1 + noise * rng.standard_normal((8, *PHOTO.shape)) for _ in range(2))
    shown = {"baked": ours, "fields": ours, "mitsuba": theirs + brighter}
    for name, passes in shown.items():
        found.pictures[name] = Pictures()
        found.pictures[name].add(passes.astype(np.float32), PHOTO)
        if name != "baked":
            found.excess[name] = [{block: excess(passes, ours, PHOTO, block) for block in BLOCKS}]
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


def test_what_noise_hides_in_pixels_is_decided_by_the_smallest_blocks_that_do():
    found = verified(1e-4)
    found.excess["mitsuba"] = [{1: (0.0, 1e-3), 4: (1e-5, 1e-5), 16: (0.0, 0.0)}]  # of a squared difference of 0.01
    found.judge()
    (verdict,) = (verdict for verdict in found.verdicts if verdict.name.startswith("mitsuba's PSNR"))
    assert (verdict.name, verdict.state) == ("mitsuba's PSNR less ours by means over 4 x 4 pixels, dB", "kept")
    assert (verdict.value, verdict.error) == found.difference("mitsuba", 4)


def test_pictures_that_differ_miss_their_bounds():
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
        with mitsuba.fastest_mitsuba() as module:
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
