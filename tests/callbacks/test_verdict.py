"""What scores mean in words, and what no photograph shows."""

import math

import numpy as np

from neurad.callbacks.verdict import verdict
from neurad.metrics.unseen import NEITHER, SEEN, UNSEEN, Unseen, seen_map

GOOD = {"albedo_psnr": 30.0, "albedo_psnr_constant": 15.0, "psnr_srgb": 25.0, "psnr_srgb_constant": 20.0}


def test_the_verdict_is_one_sentence():
    found = verdict(GOOD)
    assert found.warnings == []
    assert "albedo closely follows the truth (30.0 dB; the best constant has 15.0)" in found.sentence
    assert "the pictures roughly follow the photographs (25.0 dB" in found.sentence
    assert found.sentence.count(". ") == 0


def test_what_is_below_the_best_constant_is_said_in_words():
    scores = GOOD | {"roughness_psnr": 14.0, "roughness_psnr_constant": 15.0}
    found = verdict(scores)
    assert "roughness is not recovered (14.0 dB; the best constant has 15.0)" in found.sentence
    assert len(found.warnings) == 1
    assert "Roughness is not above the best constant" in found.warnings[0]
    seen = verdict(scores | {"roughness_psnr_seen": 17.0, "roughness_psnr_constant_seen": 16.0})
    assert "where no photograph looks" in seen.warnings[0]
    both = verdict(scores | {"roughness_psnr_seen": 15.0, "roughness_psnr_constant_seen": 16.0})
    assert both.warnings[0].endswith("Do not rely on it.")


def test_nothing_is_called_wrong_for_not_being_above_a_constant_that_is_exact():
    exact = {"roughness_psnr_constant": math.inf, "roughness_psnr_constant_seen": math.inf}
    found = verdict(GOOD | exact | {"roughness_psnr": 26.0, "roughness_psnr_seen": 26.0})
    assert "roughness is the same everywhere (26.0 dB; the best constant is exact)" in found.sentence
    assert found.warnings == []
    rounded = verdict(GOOD | {"roughness_psnr": 26.0, "roughness_psnr_constant": 76.3})  # half floats
    assert "roughness is the same everywhere (26.0 dB; the best constant has 76.3)" in rounded.sentence
    both = verdict(GOOD | exact | {"roughness_psnr": math.inf})
    assert "roughness is the same everywhere (exact; the best constant is exact)" in both.sentence
    assert "albedo closely follows the truth (exact; the" in verdict(GOOD | {"albedo_psnr": math.inf}).sentence


def test_what_is_below_in_a_part_of_the_views_is_said_too():
    scores = GOOD | {"albedo_psnr_lit_glossy": 20.0, "albedo_psnr_constant_lit_glossy": 28.0}
    said = "Albedo is not above the best constant on glossy surfaces with light on them: 20.00 dB against 28.00 dB."
    assert verdict(scores).warnings == [said]
    assert verdict(scores | {"albedo_psnr_lit_glossy": 29.0}).warnings == []


def test_without_true_materials_only_pictures_are_judged():
    found = verdict({"psnr_srgb": 25.0, "psnr_srgb_constant": 20.0}, "training photographs")
    assert found.sentence.startswith("In the training photographs the pictures roughly follow")
    assert "no true materials" in found.sentence
    assert "nothing" in verdict({}).sentence


def view():
    counted, seen = np.ones((2, 5), bool), np.ones((2, 5), bool)
    counted[0, 0] = seen[0, 0] = False  # an emitter
    seen[0, 1] = False  # a surface that no photograph shows
    truth = np.full((2, 5, 3), 0.5, np.float32)
    found = truth + 0.1
    found[0, 0], found[0, 1] = 9.0, truth[0, 1] + 0.4
    return {"seen": seen_map(counted, seen), "albedo": found, "albedo_true": truth}


def test_what_no_photograph_shows_is_counted_with_the_error_that_it_carries():
    one = view()
    assert one["seen"][0, :3, 0].tolist() == [NEITHER, UNSEEN, SEEN]
    found = Unseen.of([one, one])
    assert found.masks[0].sum() == 1
    assert found.fraction == 1 / 9
    np.testing.assert_allclose(found.squared["albedo"], 0.16 / (0.16 + 8 * 0.01), rtol=1e-5)
    expected = "11 % of the surfaces in the held-out views are in no training photograph; these carry 67 % of the "
    assert found.sentence() == expected + "squared error of albedo."
    assert found.summary().sentence() == found.sentence()


def test_nothing_is_claimed_where_it_is_not_known():
    assert Unseen.of([{}]).sentence() == ""
    all_seen = view() | {"seen": np.ones((2, 5, 1), np.float32)}
    assert Unseen.of([all_seen]).sentence().startswith("Every surface")
    assert Unseen.of([all_seen]).hatching("this view") == ""
