"""A setting that does not exist: one sentence that says where it stands and which one was probably meant."""

import pytest
from helpers.tiny_fit import fails

from neurad.runs.messages import nearest

KNOWN = ["model.sampling.spp", "model.sampling.guide", "evaluation.spp", "evaluation.fraction", "trainer.max_steps"]


@pytest.mark.parametrize(
    ("key", "meant"),
    [
        ("model.sampling.sppp", "model.sampling.spp"),
        ("evaluation.sp", "evaluation.spp"),
        ("modell.smpling.spp", "model.sampling.spp"),
        ("max_steps", "trainer.max_steps"),
        ("evaluation.share", None),  # no neighbour in the same group is taken for it
        ("attic", None),
    ],
)
def test_the_nearest_setting(key, meant):
    assert nearest(key, KNOWN) == meant


def test_there_may_be_no_settings():
    assert nearest("model.sampling.spp", []) is None


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("data: {patchs: 3}", "data.patchs is not a known setting, did you mean data.patches?"),
        (
            "modell: {sampling: {spp: 3}}",
            "modell.sampling.spp is not a known setting, did you mean model.sampling.spp?",
        ),
        ("base: 5", "base must be the name of a config, or a list of names"),
        ("base: ${data.scene}", "base must be the name of a config, or a list of names"),
        ("evaluation: null", "evaluation: it is a group of settings, write them below it"),
        ("model: {sampling: {spp: null}}", "model.sampling.spp: null is no value for it, leave it out"),
        ("model: {radiance: {grid: 5}}", "model.radiance.grid: it is a group of settings, write them below it"),
        ("data: 5", "data: it is a group of settings, write them below it"),
        ("trainer: 5", "trainer: it is a group of settings, write them below it"),
        ("data: " + "[" * 500 + "]" * 500, "it is nested too deeply to be a config"),
    ],
)
def test_a_key_in_a_config_file(tmp_path, capfd, text, said):
    (tmp_path / "mine.yaml").write_text(text)
    sentence = fails(capfd, "fit", "--config", "cornell.yaml", "--config", tmp_path / "mine.yaml")
    assert sentence == f"neurad: error: config {tmp_path / 'mine.yaml'}: {said}"


def test_a_launcher_s_variable_that_is_no_number(capfd, monkeypatch):
    monkeypatch.setenv("LOCAL_RANK", "x")
    said = "neurad: error: the environment variable LOCAL_RANK is 'x', not a whole number; unset it"
    assert fails(capfd, "fit", "--config", "cornell.yaml") == said
