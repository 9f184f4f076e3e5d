"""Sheets of a view, charts, and what a page consists of."""

import re

import numpy as np
import pytest

from neurad.pages import page
from neurad.pages.chart import ACCENT, PALE, Line, chart
from neurad.pages.colours import ERRORS, NUMBERS, PERIOD, enlarged, hatched, ramp, reduced
from neurad.pages.draw import draw, lettered
from neurad.pages.sheet import BOX, MAX_WIDTH, MIN_WIDTH, Crop, Scale, Sheet, Tile, worst_squares

GREY = np.full((8, 12, 3), 128, np.uint8)


def sheet(picture=GREY, unseen=None, **options):
    scale = Scale(ERRORS, "0", "1", "error, darker is better")
    tiles = [Tile("a", "Found", picture, pair="b"), Tile("b", "True", picture, pair="a")]
    error, other = Tile("c", "Error", picture, scale), Tile("d", "Other", picture, scale)
    return Sheet("A view", {"one": [*tiles, error], "two": [None, other]}, unseen, **options)


@pytest.mark.parametrize("width", [5, 64, 100, 256, 300, 1023, 1024, 4000])
def test_pictures_are_enlarged_by_whole_numbers_or_reduced(width):
    one = sheet(np.zeros((2, width, 3), np.uint8))
    zoom, by = one.zoom
    assert 1 in (zoom, by)
    assert MIN_WIDTH <= width // by * zoom < 2 * max(MAX_WIDTH, MIN_WIDTH)


def test_what_is_not_determined_is_veiled_in_its_own_tile_and_shows_through():
    doubtful = np.zeros((8, 12), bool)
    doubtful[2:6, 3:9] = True
    one = sheet()
    marked = Tile("a", "Found", GREY, doubtful=doubtful)
    shown = one.displayed(marked)
    mask = enlarged(doubtful, one.zoom[0])
    assert (shown[~mask] == 128).all()
    assert 0.1 < (shown[mask] > 128).mean() < 0.3  # thin lines, and the map between them
    assert (shown[mask] >= 128).all()


def test_short_rows_are_drawn_beside_each_other_and_nothing_is_blurred():
    tile = Tile("a", "", GREY)
    packed = Sheet("", {"one": [tile] * 4, "two": [tile] * 2, "three": [tile] * 2, "four": [tile]}).packed
    assert [len(tiles) for tiles in packed] == [4, 4, 1]

    picture = np.random.default_rng(0).integers(0, 256, (4, 64, 3), np.uint8)
    shown = sheet(picture).displayed(Tile("a", "", picture))
    np.testing.assert_array_equal(shown[::4, ::4], picture)
    np.testing.assert_array_equal(shown, enlarged(picture, 4))
    np.testing.assert_array_equal(reduced(enlarged(picture, 3), 3), picture)


def test_a_picture_alone_in_its_row_is_no_larger_than_others():
    alone = Tile("d", "Other", GREY)
    shown = Sheet("", {"one": [Tile(key, "", GREY) for key in "abc"], "two": [alone]})
    assert page.sheet(shown, "v").count("--columns:3") == 2


def test_what_is_compared_has_its_colour_bar_below(look_at, tmp_path):
    scale = Scale(NUMBERS, "0 smooth", "1 rough", "roughness")
    pair = [Tile("a", "Found", GREY, scale=scale, pair="b"), Tile("b", "True", GREY, scale=scale)]
    (tmp_path / "page.html").write_text(page.page("", [page.sheet(Sheet("", {"one": pair}), "v")]))
    seen = look_at(tmp_path / "page.html", width=390)
    box, low, high = (
        seen.page.locator(f".slider {part}").bounding_box()
        for part in (".box", ".ends span >> nth=0", ".ends span >> nth=1")
    )
    assert low["x"] == box["x"]
    assert high["x"] + high["width"] == pytest.approx(box["x"] + box["width"], abs=1)
    assert box["y"] + box["height"] < low["y"] == high["y"]
    assert seen.page.locator(".row .tile").count() == 2
    first, second = (seen.page.locator(".row .tile").nth(k).bounding_box() for k in (0, 1))
    assert first["y"] == second["y"]  # two pictures a row on a phone


def test_one_score_stands_in_the_middle_of_its_chart():
    text = chart("PSNR in dB", "", "s", [Line("one", np.float32([100]), np.float32([20]), ACCENT)])
    ticks = [float(found) for found in re.findall(r">(\d+)</text>", text) if float(found) > 40]
    assert 50 <= min(ticks) < 100 < max(ticks) <= 200


@pytest.mark.parametrize(("width", "stroke"), [(64, 2), (500, 3)])
def test_crops_are_framed_as_thickly_as_the_picture_is_wide(width, stroke):
    picture = np.full((40, width, 3), 128, np.uint8)
    one = Sheet("", {"one": [Tile("a", "", picture)]}, crops=[Crop("A", 10, 10, 20, "")])
    zoom, _ = one.zoom
    row = one.displayed(one.tiles[0])[20 * zoom]
    assert (row == BOX).all(-1).sum() == 2 * stroke
    assert lettered(one, one.tiles[0]).shape == one.displayed(one.tiles[0]).shape


def test_what_no_photograph_shows_is_hatched_in_every_tile_and_nowhere_else():
    unseen = np.zeros((8, 12), bool)
    unseen[2:6, 3:9] = True
    one = sheet(unseen=unseen)
    mask = enlarged(unseen, one.zoom[0])
    for tile in one.tiles:
        shown = one.displayed(tile)
        assert (shown[~mask] == 128).all()
        assert {0, 128, 255} == set(np.unique(shown[mask]))
    lines = hatched(np.full((40, 40, 3), 128, np.uint8), np.ones((40, 40), bool))
    np.testing.assert_array_equal(lines[:-PERIOD, :], lines[PERIOD:, :])  # one pattern for all tiles


def test_crops_are_where_errors_are_largest_and_apart():
    first, second = np.zeros((40, 60), np.float32), np.zeros((40, 60), np.float32)
    first[3, 50] = 5.0
    first[30, 10] = 4.0
    second[4, 51] = 7.0
    second[20, 20] = 1.0
    a, b = worst_squares([("one", first), ("two", second), ("three", first)])
    assert (a.letter, a.meaning, b.letter, b.meaning) == ("A", "one", "B", "two")
    assert a.y <= 3 < a.y + a.side
    assert a.x <= 50 < a.x + a.side
    assert b.x + b.side <= a.x or b.y >= a.y + a.side
    assert worst_squares([("none", np.zeros((8, 8), np.float32))]) == []


def test_a_sheet_is_drawn_with_its_bars_and_frames():
    error = np.zeros((8, 12), np.float32)
    error[1, 1] = 1.0
    one = sheet(crops=worst_squares([("it is wrong here", error)]), crop_keys=("a", "b"), notes=["A word. " * 60])
    picture = draw(one)
    assert picture.dtype == np.uint8
    assert picture.shape[1] > 3 * MIN_WIDTH
    assert (picture == BOX).all(-1).sum() > 3 * 4 * 40
    for colour in ramp(ERRORS)[[8, 32, 56]]:  # of the colour bar alone: the tiles are grey
        assert (np.abs(picture.astype(int) - colour).sum(-1) < 12).any()
    taller = draw(sheet(crops=one.crops, crop_keys=one.crop_keys, notes=["A word. " * 300]))
    assert taller.shape[0] > picture.shape[0]
    assert taller.shape[1] == picture.shape[1]


def test_a_chart_has_its_curves_bands_and_levels():
    x, y = np.array([10, 20, 40], np.float32), np.array([1, 2, 3], np.float32)
    none, level = np.zeros(0, np.float32), np.array([2.5], np.float32)
    lines = [Line("a <b>", x, y, "red", low=y - 1, high=y + 1), Line("c", none, level, PALE, (6.0, 4.0))]
    text = chart("PSNR", "higher is better", "s", lines)
    assert "a &lt;b&gt;</text>" in text
    assert "higher is better" in text
    assert text.count('id="FillBetweenPolyCollection') == 1
    assert text.count("stroke-dasharray") == 2  # on the chart and in its key
    assert PALE not in text
    assert "var(--pale)" in text
    assert not re.findall(r"(?:src|href)=\"(?!#)|url\((?!#)", text)
    assert chart("PSNR", "", "s", [Line("c", none, level, "grey")]) == ""
    for few in (1, 2):  # are points, in the key too, and no line joins them
        single = chart("PSNR", "", "s", [Line("a", x[:few], y[:few], "#ff0000")])
        assert "nan" not in single
        assert len(re.findall(r"<use [^>]*fill: #ff0000", single)) == few + 1
        assert "fill: none; stroke: #ff0000" not in single
