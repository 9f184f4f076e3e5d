"""The line of a fit: 80 columns, scores with their age, and an end at 0:00."""

import re
import time
from types import SimpleNamespace

import pytest
import torch

from neurad.callbacks import Bar, progress
from neurad.runtime.progress import COLUMNS
from neurad.training.schedule import Progress


def trainer(monkeypatch, by_steps=None, by_time=None, seconds=0.0, scores=None, age=0.0):
    """What the bar looks at of a trainer."""
    monkeypatch.setattr(progress, "fraction_done", lambda _: Progress(by_steps, by_time, seconds))
    evaluation = SimpleNamespace(last_scores=scores or {}, last_scored=time.monotonic() - age)
    return SimpleNamespace(callbacks=[evaluation])


def module(iteration=1234, **losses):
    return SimpleNamespace(iteration=iteration, last_losses={k: torch.tensor(v) for k, v in losses.items()})


SCORES = {"psnr_srgb": 28.27, "albedo_psnr": 33.73}


@pytest.mark.parametrize("iteration", [1, 12345, 123456789])
@pytest.mark.parametrize("age", [0.0, 12.0, 599.0, 7200.0])
@pytest.mark.parametrize("seconds", [10.0, 3600.0, 86400.0])
def test_it_has_80_columns(monkeypatch, iteration, age, seconds):
    found = trainer(monkeypatch, by_time=0.25, seconds=seconds, scores=SCORES, age=age)
    text = Bar().text(found, module(iteration), COLUMNS - 1)
    assert len(text) == COLUMNS - 1
    assert text.startswith("fit  25% |")
    assert f"step {iteration}" in text
    assert "image 28.3 albedo 33.7 dB" in text


def test_step_picture_albedo_with_its_age_and_time_left(monkeypatch):
    found = trainer(monkeypatch, by_time=0.25, seconds=60.0, scores=SCORES, age=12.4)
    text = Bar().text(found, module(), COLUMNS - 1)
    assert re.fullmatch(
        r"fit  25% \|#+ +\| step 1234, image 28.3 albedo 33.7 dB \(12 s ago\), 3:00 left", text.rstrip()
    )


def test_before_the_first_scores_there_is_the_loss(monkeypatch):
    text = Bar().text(trainer(monkeypatch, by_steps=0.1), module(3, rhs=0.25, lhs=0.5), 79)
    assert "step 3, loss 0.75" in text


@pytest.mark.parametrize("over", [1.0, 1.02, 1.5])
def test_it_ends_at_zero_whatever_comes_after(monkeypatch, over):
    found = trainer(monkeypatch, by_time=over, seconds=240.0 * over, scores=SCORES, age=5.0)
    running = Bar().text(found, module(), 79)
    assert "0:00 left" in running
    ended = Bar().text(found, module(), 79, ended=True)
    assert ended.startswith("fit 100% |")
    assert ended.rstrip().endswith("image 28.3 albedo 33.7 dB, 0:00 left")
    assert "-" not in running + ended


def test_of_two_limits_the_nearer_one_counts(monkeypatch):
    bar = Bar()
    bar._began = (time.monotonic() - 10.0, 0.0)
    text = bar.text(trainer(monkeypatch, by_steps=0.5, by_time=0.1, seconds=10.0), module(), 79)
    assert "0:10 left" in text or "0:09 left" in text
    assert text.startswith("fit  50%")


def test_a_continued_fit_counts_from_where_it_began(monkeypatch):
    bar = Bar()
    bar._began = (time.monotonic() - 10.0, 0.5)
    text = bar.text(trainer(monkeypatch, by_steps=0.75), module(), 79)
    assert "0:10 left" in text or "0:09 left" in text


def test_a_log_gets_a_line_now_and_then(monkeypatch, capsys):
    bar = Bar()
    found, fitted = trainer(monkeypatch, by_steps=0.5, scores=SCORES), module()
    bar._began = (time.monotonic(), 0.0)
    for _ in range(100):
        bar.on_train_batch_end(found, fitted)
    bar.on_train_end(found, fitted)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2
    assert lines[0].startswith("fit  50%")
    assert lines[1].endswith("0:00 left")
    bar.disable()
    bar.on_train_batch_end(found, fitted)
    assert capsys.readouterr().err == ""
