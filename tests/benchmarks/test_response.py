"""What photographs ask for beside what is wrong: closed forms, and the command on a tiny fit."""

import csv

import numpy as np
import pytest
from helpers.highlight_pixels import CHANGE, PATCHES, means
from helpers.tiny_fit import fails, fit, write_tiny_config

from benchmarks.response import BINS, BLOCKS, Estimate, changes, in_patches, slopes_on
from neurad.cli import main
from neurad.evidence.roughness_evidence import Evidence, evidence

RNG = np.random.default_rng(3)


def cube(p):
    return p


def test_the_standard_error_of_a_mean_is_that_of_its_blocks():
    values = RNG.standard_normal(64 * BLOCKS)
    blocks = values.reshape(BLOCKS, -1).mean(1)
    found = Estimate.ratio(values, np.ones(len(values)))
    assert found.value == pytest.approx(values.mean())
    assert found.error == pytest.approx(blocks.std(ddof=1) / np.sqrt(BLOCKS), rel=1e-6)
    assert np.isnan(Estimate.ratio(values, np.zeros(len(values))).value)


def patches(wrong, part):
    """That ask for a part of what is wrong with them, some of nothing."""
    information = RNG.lognormal(3.0, 2.0, len(wrong)) * (np.arange(len(wrong)) % 5 > 0)
    return Evidence(64, RNG.random((len(wrong), 3)), information, information * part * wrong)


def test_slopes_and_changes_are_those_that_were_put_in():
    wrong = RNG.normal(0.0, 0.1, 4000)
    for part in (0.6, -0.2):
        for found in slopes_on(patches(wrong, part), wrong):
            assert found.value == pytest.approx(part)
            assert found.error == pytest.approx(0.0, abs=1e-9)
    truth = RNG.uniform(0.1, 0.6, 4000)
    step = np.select([truth < BINS[0], truth < BINS[1]], [0.1, 0.0], -0.3)
    low, middle, high, known = changes(patches(step, 1.0), truth)
    assert [x.value for x in (low, middle, high)] == pytest.approx([0.1, 0.0, -0.3])
    assert 0.0 < known.value < 0.1


def test_pixels_that_ask_for_a_third_of_what_is_wrong_have_that_slope():
    """Over 20 draws within four standard errors."""
    found = []
    for seed in range(20):
        draw = means(seed=seed)
        asked = evidence(draw, cube, PATCHES)[0]
        wrong = in_patches(draw, cube, asked.side, np.full(len(draw), 3.0 * CHANGE))
        found.append(slopes_on(asked, wrong)[0].value)
    assert np.mean(found) == pytest.approx(1.0 / 3.0, abs=4 * np.std(found) / np.sqrt(20) + 0.02)


@pytest.mark.main
def test_the_command_sets_what_is_asked_for_beside_what_is_wrong(tiny, capfd):
    write_tiny_config(base="kitchen.yaml")
    fit("--trainer.max_steps", "20")
    capfd.readouterr()
    main(["bench", "response", "--pixels", "2000", "--spp", "16", "--out", "response.csv"])
    said = capfd.readouterr().out
    assert "roughness is off by 0." in said
    rows = list(csv.DictReader((tiny / "response.csv").open()))
    asked = {name: [row for row in rows if row["row"] == name] for name in ("as fitted", "with the true roughness")}
    assert len(rows) == 3 * 2 + 2 * 4
    assert all(np.isfinite(float(row["value"])) and float(row["standard_error"]) > 0 for row in rows)
    assert float(asked["as fitted"][0]["value"]) > float(asked["with the true roughness"][0]["value"])


@pytest.mark.main
def test_a_run_without_roughness_is_refused(tiny, capfd):
    fit("--config", "methods/path.yaml", "--trainer.max_steps", "1")
    assert "needs a fit of roughness" in fails(capfd, "bench", "response")
