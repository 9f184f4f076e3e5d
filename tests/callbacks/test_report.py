"""What a fit and ``neurad test`` leave for a person: ``report.html`` in a browser, words, and TensorBoard's page."""

import os
import re
from contextlib import redirect_stdout
from io import StringIO

import pytest
from browser import LAPTOP
from helpers.tiny_fit import fit, run_folder, write_tiny_config
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from neurad.cli import main


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The folder of a run that was fitted and tested, and what both of them said."""
    before, said = os.getcwd(), []
    folder = tmp_path_factory.mktemp("run")
    os.chdir(folder)
    try:
        write_tiny_config(evaluation={"every_n_steps": 4, "pictures": 1})
        for words in (None, ["test"]):
            with redirect_stdout(StringIO()) as out:
                if words is None:
                    fit("--trainer.max_steps=8", "--trainer.log_every_n_steps=2")
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
    chart = page.locator(".chart").first  # of two evaluations: points, and only the best constant is a line
    assert chart.locator("circle title").first.text_content().startswith("this run: ")
    assert all(text.startswith("best constant: ") for text in chart.locator("polyline title").all_text_contents())

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


def test_tensorboard_has_four_charts_first_and_the_constant_in_them(run):
    folder, _ = run
    events = {path.name: EventAccumulator(str(path)).Reload() for path in folder.glob("cornell-*")}
    assert set(events) == {"cornell-radiometric", "cornell-best-constant"}
    ours, constant = events["cornell-radiometric"], events["cornell-best-constant"]
    first = {tag for tag in ours.Tags()["scalars"] if tag.startswith("fit/")}
    assert first == {"fit/albedo_psnr", "fit/picture_psnr", "fit/loss"}  # cornell has no roughness to find
    assert {tag.partition("/")[0] for tag in ours.Tags()["scalars"]} == {"fit", "more"}
    assert [event.step for event in ours.Scalars("fit/albedo_psnr")] == [4, 8]
    assert [event.step for event in ours.Scalars("fit/loss")] == [2, 4, 6, 8]
    assert {"fit/albedo_psnr", "fit/picture_psnr"} <= set(constant.Tags()["scalars"]) <= set(ours.Tags()["scalars"])
    values = [event.value for event in constant.Scalars("fit/albedo_psnr")]
    assert values[0] == values[1]
    assert {tag.partition("/")[0] for tag in ours.Tags()["images"]} == {"views"}
    cards = {tag.removeprefix("views/000/"): ours.Images(tag)[0] for tag in ours.Tags()["images"]}
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
