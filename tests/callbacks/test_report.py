"""What a fit and ``neurad test`` leave for a person: ``report.html`` in a browser, words, and TensorBoard's page."""

import math
import os
import re
import time
from contextlib import redirect_stdout
from io import BytesIO, StringIO
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from browser import LAPTOP
from helpers.tiny_fit import fit, run_folder, write_tiny_config
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from neurad.callbacks import Bar, evaluation, progress
from neurad.callbacks.verdict import verdict
from neurad.cli import main
from neurad.metrics.unseen import NEITHER, SEEN, UNSEEN, Unseen, seen_map
from neurad.runtime.progress import COLUMNS
from neurad.training.schedule import Progress


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The folder of a run that was fitted and tested, and what both of them said."""
    before, said = os.getcwd(), []
    folder = tmp_path_factory.mktemp("run")
    os.chdir(folder)
    try:
        write_tiny_config(evaluation={"every_n_steps": 4})
        for words in (None, ["test"]):
            with redirect_stdout(StringIO()) as out, pytest.MonkeyPatch.context() as patch:
                if words is None:
                    patch.setattr(evaluation, "LOSSES_EVERY", 2)
                    patch.setattr(evaluation, "PICTURES", 1)
                    fit("--trainer.max_steps=8")
                else:
                    main(words)
            said.append(out.getvalue())
    finally:
        os.chdir(before)
    return folder / run_folder(), said


def test_fit_and_test_end_by_naming_the_report_and_how_to_go_on(run):
    folder, said = run
    for text in said:
        named, after = text.split("go on with\n")
        assert re.search(rf"open .*{folder.name}/report\.html in a browser", named)
        assert all(line.startswith(("  neurad ", "  tensorboard ")) for line in after.strip("\n").splitlines())
        assert "neurad: In the held-out views albedo " in text
        assert re.search(r"neurad: (Every surface|.* of the surfaces) in the held-out views", text)
    names = {path.name for path in (folder / "images").iterdir()}
    assert {"000_render.exr", "000_albedo.png", "000_seen.png", "000_sheet.png"} <= names


def test_the_report_in_a_browser(run, look_at, tmp_path):
    folder, _ = run
    seen = look_at(folder / "report.html", offline=True)
    page = seen.page
    assert (seen.errors, seen.network) == ([], [])
    assert seen.width() == (LAPTOP[0], LAPTOP[0])
    assert page.evaluate("[...document.images].filter(i => i.closest('figure')).every(i => i.naturalWidth > 0)")
    assert page.locator(".verdict").inner_text().startswith("In the held-out views albedo ")
    assert "How to go on" in page.inner_text("body")
    assert f"neurad view --ckpt_path {folder.name}\n" in page.inner_text("body")
    assert "Do not trust surfaces that " in page.inner_text("body")
    assert page.locator(".chart").count() >= 2
    assert {"this run", "best constant"} <= {*page.locator(".chart").first.locator("text").all_text_contents()}

    slider = page.locator(".slider").first
    clip = "element => getComputedStyle(element.querySelector('.over')).clipPath"
    before = slider.evaluate(clip)
    box = slider.locator("input").bounding_box()
    slider.locator("input").click(position={"x": 0.2 * box["width"], "y": box["height"] / 2})
    assert float(slider.locator("input").input_value()) == pytest.approx(20, abs=3)
    assert slider.evaluate(clip) != before
    slider.locator("input").press("ArrowRight")  # by the keyboard too
    assert float(slider.locator("input").input_value()) == pytest.approx(20.5, abs=3)

    for word, value, shown in (("Photograph", 0, "false"), ("Rendered", 100, "true"), ("both", 50, "false")):
        slider.get_by_role("button", name=word, exact=True).click()
        assert float(slider.locator("input").input_value()) == value
        pressed = slider.get_by_role("button", name="Rendered", exact=True).get_attribute("aria-pressed")
        assert (pressed, slider.get_by_role("button", name=word, exact=True).get_attribute("aria-pressed")) == (
            shown,
            "true",
        )
    picture, square = (slider.locator(place).first.bounding_box() for place in (".box", ".squares .tile"))
    assert square["x"] >= picture["x"] + picture["width"]  # beside it
    assert square["y"] < picture["y"] + picture["height"]

    tile, dialog = page.locator(".tile img").first, page.locator("dialog")
    assert not dialog.is_visible()
    tile.click()
    assert dialog.is_visible()
    assert dialog.locator("img").bounding_box()["width"] > 1.5 * tile.bounding_box()["width"]
    page.keyboard.press("Escape")
    assert not dialog.is_visible()
    tile.press("Enter")
    assert dialog.is_visible()
    dialog.click()
    assert not dialog.is_visible()
    assert (seen.errors, seen.network) == ([], [])
    assert seen.picture(tmp_path / "report.png").stat().st_size > 10_000


def test_the_report_on_dark_and_on_narrow_screens(run, look_at):
    folder, _ = run
    colours = []
    for dark in (False, True):
        seen = look_at(folder / "report.html", width=420, dark=dark, offline=True)
        colours.append(seen.page.evaluate("(s => [s.color, s.backgroundColor])(getComputedStyle(document.body))"))
        assert seen.width() == (420, 420)
        assert seen.errors == []
    (ink, ground), (dark_ink, dark_ground) = ([_brightness(colour) for colour in pair] for pair in colours)
    assert ink < 80 < 200 < ground
    assert dark_ground < 80 < 200 < dark_ink


def test_tensorboard_has_one_run_with_its_charts_first_and_the_constant_dashed_beside_them(run):
    folder, _ = run
    (events,) = folder.glob("*-*")
    assert events.name == "cornell-radiometric"
    ours = EventAccumulator(str(events)).Reload()
    first = {tag for tag in ours.Tags()["scalars"] if tag.startswith("fit/")}
    assert first == {"fit/albedo_psnr", "fit/picture_psnr", "fit/loss"}  # cornell has no roughness to find
    assert {tag.partition("/")[0] for tag in ours.Tags()["scalars"]} == {"fit", "more"}
    assert [event.step for event in ours.Scalars("fit/albedo_psnr")] == [4, 8]
    assert [event.step for event in ours.Scalars("fit/loss")] == [2, 4, 6, 8]
    assert not any("constant" in tag for tag in ours.Tags()["scalars"])
    charts = {tag for tag in ours.Tags()["images"] if not tag.startswith("views/")}
    assert charts == {"fit/albedo_psnr_chart", "fit/picture_psnr_chart"}
    assert [event.step for event in ours.Images("fit/albedo_psnr_chart")] == [4, 8]
    before, after = (np.asarray(Image.open(BytesIO(x.encoded_image_string))) for x in ours.Images(min(charts)))
    assert before.shape == after.shape == (208, 340, 3)
    grey = [(abs(x.astype(int) - 0x55).max(-1) < 8).sum(1).max() for x in (before, after)]
    assert all(100 < count < 220 for count in grey)  # a dashed line across
    cards = {tag.removeprefix("views/000/"): ours.Images(tag)[0] for tag in ours.Tags()["images"] if "views/" in tag}
    assert {"render", "photograph", "render_error", "albedo", "albedo_true", "albedo_error"} <= set(cards)
    assert all(165 < card.width <= 350 for card in cards.values())
    assert all(card.height > card.width - 40 for card in cards.values())  # a heading over it, and a bar below
    layout = ours.Tensors("custom_scalars__config__")[0].tensor_proto.string_val[0].decode("utf-8", "replace")
    assert "fit/albedo_psnr" in layout
    assert "Roughness" not in layout


def test_tensorboard_has_the_settings_beside_the_scores(run):
    folder, _ = run
    ours = EventAccumulator(str(folder / "cornell-radiometric")).Reload()
    assert {"_hparams_/experiment", "_hparams_/session_start_info"} <= set(ours.PluginTagToContent("hparams"))
    content = ours.PluginTagToContent("hparams")["_hparams_/session_start_info"]
    for word in (b"Scene", b"cornell", b"Method", b"radiometric", b"sampling.spp", b"optimization.albedo", b"Steps"):
        assert word in content


def _brightness(colour):
    """Mean of the channels of ``rgb(...)``."""
    values = [int(value) for value in re.findall(r"\d+", colour)[:3]]
    return sum(values) / 3


# ---- what scores mean in words, and what no photograph shows


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


def test_parts_of_the_views_are_judged_and_without_true_materials_pictures_alone():
    scores = GOOD | {"albedo_psnr_lit_glossy": 20.0, "albedo_psnr_constant_lit_glossy": 28.0}
    said = "Albedo is not above the best constant on glossy surfaces with light on them: 20.00 dB against 28.00 dB."
    assert verdict(scores).warnings == [said]
    assert verdict(scores | {"albedo_psnr_lit_glossy": 29.0}).warnings == []

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
    assert Unseen.of([all_seen]).fraction == 0.0


# ---- the line of a fit: 80 columns, scores with their age, and an end at 0:00


def trainer(monkeypatch, by_steps=None, by_time=None, seconds=0.0, scores=None, age=0.0):
    """What the bar looks at of a trainer."""
    monkeypatch.setattr(progress, "fraction_done", lambda _: Progress(by_steps, by_time, seconds))
    evaluation = SimpleNamespace(last_scores=scores or {}, last_scored=time.monotonic() - age)
    return SimpleNamespace(callbacks=[evaluation])


def module(iteration=1234, **losses):
    return SimpleNamespace(iteration=iteration, last_losses={k: torch.tensor(v) for k, v in losses.items()})


SCORES = {"psnr_srgb": 28.27, "albedo_psnr": 33.73}
SCORED = "image 28.3 albedo 33.7 dB"


@pytest.mark.parametrize(
    ("done", "began", "fitted", "shown"),
    [
        (dict(by_time=0.25, seconds=60.0, scores=SCORES, age=12.4), None, module(),
         rf"fit  25% \|#+ +\| step 1234, {SCORED} \(12 s ago\), 3:00 left"),
        (dict(by_time=0.25, seconds=86400.0, scores=SCORES, age=7200.0), None, module(123456789),
         rf"fit  25% \|.*step 123456789, {SCORED}.*"),
        (dict(by_steps=0.1), None, module(3, rhs=0.25, lhs=0.5), ".*step 3, loss 0.75.*"),
        (dict(by_time=1.5, seconds=360.0, scores=SCORES, age=5.0), None, module(), "[^-]*0:00 left"),
        # of two limits the nearer one counts; a continued fit counts from where it began
        (dict(by_steps=0.5, by_time=0.1, seconds=10.0), 0.0, module(), "fit  50%.*0:(10|09) left"),
        (dict(by_steps=0.75), 0.5, module(), ".*0:(10|09) left"),
    ],
)  # fmt: skip
def test_the_line_of_a_fit(monkeypatch, done, began, fitted, shown):
    """It has 80 columns with the end of the line, whatever it says."""
    bar = Bar()
    bar._began = None if began is None else (time.monotonic() - 10.0, began)
    text = bar.text(trainer(monkeypatch, **done), fitted, COLUMNS - 1)
    assert len(text) == COLUMNS - 1
    assert re.fullmatch(shown, text.rstrip()), text


def test_a_log_gets_a_line_now_and_then(monkeypatch, capsys):
    """And one at the end, which ends at zero."""
    bar = Bar()
    found, fitted = trainer(monkeypatch, by_steps=0.5, scores=SCORES), module()
    bar._began = (time.monotonic(), 0.0)
    for _ in range(100):
        bar.on_train_batch_end(found, fitted)
    bar.on_train_end(found, fitted)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2
    assert lines[0].startswith("fit  50%")
    assert re.fullmatch(rf"fit 100% \|.*{SCORED}, 0:00 left", lines[1].rstrip())
    bar.disable()
    bar.on_train_batch_end(found, fitted)
    assert capsys.readouterr().err == ""
