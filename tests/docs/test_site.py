"""The pages themselves: length, links, plots, and the site that they make."""

import importlib.util
import re

import matplotlib.image
import numpy as np
import pytest
from helpers.pages import DOCS, PAGES, REPOSITORY, pages, without_blocks
from helpers.tiny_fit import few_views, fit, run_folder, write_tiny_config
from PIL import Image, ImageSequence

from neurad.images.image_io import write_exr


def commands(text):
    """Blocks of commands, without the words on them."""
    blocks = re.findall(r"(?:^ {4}\S.*\n)+", text, re.M)
    return [[re.sub(r"\s+#.*", "", line.strip()) for line in block.splitlines()] for block in blocks]


def test_the_three_ways_in_are_short_and_the_home_page_has_the_same():
    start, *doors = commands((REPOSITORY / "README.md").read_text())
    assert len(start) == 2
    assert commands((DOCS / "index.md").read_text()) == doors
    assert [len(door) < 10 for door in doors] == [True] * 3


def test_the_readme_is_short_and_no_line_of_its_code_is_cut_off():
    """A page of code on GitHub shows 90 letters beside the margins."""
    text = (REPOSITORY / "README.md").read_text()
    assert len(text.encode()) <= 8192
    fenced = [line for block in re.findall(r"^```\w+\n(.*?)^```", text, re.S | re.M) for line in block.splitlines()]
    lines = [*fenced, *re.findall(r"^ {4}(\S.*)$", text, re.M)]
    assert len(fenced) > 10
    assert [line for line in lines if len(line) > 90] == []


def anchors(page):
    """Anchors of a page's headings, as mkdocs makes them."""
    headings = re.findall(r"^#+ (.*)$", re.sub(r"^```.*?^```", "", page.read_text(), flags=re.S | re.M), re.M)
    return {re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", heading).strip().lower()) for heading in headings}


@pages
def test_links_resolve(page):
    for link in re.findall(r"\]\(([^)\s]+)\)", without_blocks(page.read_text())):
        if link.startswith("https://"):
            continue
        file, _, anchor = link.partition("#")
        target = (page.parent / file).resolve() if file else page
        assert target.is_file(), link
        assert not anchor or anchor in anchors(target), link


def script(name):
    """A script of ``docs/`` as a module."""
    spec = importlib.util.spec_from_file_location(name, DOCS / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_pages_of_results_are_made_of_the_data(tmp_path):
    results = script("results")
    results.main(["--out", str(tmp_path)])
    written = {path.name: path.read_text() for path in tmp_path.glob("*.md")}
    assert sorted(written) == ["captures.md", "results.md", "studies.md"]
    assert all((DOCS / name).read_text() == text for name, text in written.items())
    page = "".join(written.values())
    drawn = {path.stem for path in tmp_path.glob("*.png")}
    shown = set(re.findall(r"\]\((\w+)\.png\)", page))
    assert drawn == set(results.PLOTS)
    assert drawn <= shown
    assert all((DOCS / f"{name}.png").stat().st_size < 300_000 for name in shown)
    tables = set(re.findall(r"^<!-- table: (\w+) -->$", page, re.M))
    assert {path.stem for path in (DOCS / "data").glob("*.csv")} == tables | drawn


def test_the_readme_has_the_numbers_of_the_demo():
    results = script("results")
    shown = re.findall(r"\| ([\d.]+) dB ", (REPOSITORY / "README.md").read_text())
    assert len(shown) >= 4
    assert set(shown) <= {cell for row in results.rows("builtin") for cell in row.values()}
    end = results.rows("patterns")[-1]
    assert {end["albedo_psnr"], end["roughness_psnr"]} <= set(results.rows("builtin")[3].values())


def test_the_picture_of_the_readme_is_made_of_a_run(tiny, capsys, monkeypatch):
    few_views(monkeypatch, "kitchen")
    write_tiny_config(base="kitchen.yaml")
    fit("--trainer.max_steps=2")
    picture = script("picture")
    picture.main([str(run_folder()), "--spp", "1", "--width", "160", "--out", str(tiny / "kitchen.jpg")])
    assert "lamps" in capsys.readouterr().err  # what is lit differently is said
    assert matplotlib.image.imread(tiny / "kitchen.jpg").shape == (72, 160, 3)
    shown = DOCS / "images" / "kitchen.jpg"
    assert matplotlib.image.imread(shown).shape == (720, 1600, 3)
    assert shown.stat().st_size < 700_000


def test_the_film_of_the_lamps_takes_six_seconds_and_three_megabytes():
    file = DOCS / "screens" / "lamps.gif"
    with Image.open(file) as film:
        frames = [frame.info["duration"] for frame in ImageSequence.Iterator(film)]
    assert sum(frames) == pytest.approx(6000, abs=100)
    assert file.stat().st_size < 3_000_000


def test_a_room_in_blender_stands_beside_what_it_was(tmp_path, monkeypatch):
    """At one exposure, that of the room with the recovered materials."""
    monkeypatch.syspath_prepend(DOCS)
    rooms = [tmp_path / f"{value}.exr" for value in (0.25, 1.0)]
    for path in rooms:
        write_exr(path, np.full((450, 800, 3), float(path.stem), np.float32))
    script("before_after").draw(rooms, tmp_path / "blender.jpg")
    made = matplotlib.image.imread(tmp_path / "blender.jpg")
    assert made.shape == matplotlib.image.imread(DOCS / "images" / "blender.jpg").shape == (450, 1604, 3)
    assert made[50, 400].max() < made[50, 1200].min() < 255


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    pytest.importorskip("mkdocs", reason="needs mkdocs (extra docs)")
    from mkdocs.commands.build import build
    from mkdocs.config import load_config

    folder = tmp_path_factory.mktemp("site")
    build(load_config(str(REPOSITORY / "mkdocs.yml"), site_dir=str(folder), strict=True))
    return folder


def test_formulas_are_set_and_no_page_is_wider_than_the_window(site, look_at):
    for name in ("index.html", "method/index.html", "results/index.html"):
        seen = look_at(site / name, width=1280, offline=True)
        for width in (1280, 390):
            seen.page.set_viewport_size({"width": width, "height": 800})
            assert seen.width() == (width, width), name
        assert seen.network == []
        formulas = (DOCS / "method.md").read_text().count("```math\n") if name.startswith("method") else 0
        assert [seen.page.locator(what).count() for what in (".katex-display", ".katex-error")] == [formulas, 0]
    assert seen.page.locator(".navbar .dropdown-toggle").count() == 5


def test_the_site_loads_nothing_from_elsewhere(site):
    built = sorted(site.rglob("*.html"))
    assert len(built) >= len(PAGES) - 2
    for path in built:
        loaded = re.findall(r"(?:\bsrc=|<link[^>]*href=)[\"'](https?:)?//", path.read_text())
        assert loaded == [], path.name
    for path in site.rglob("*.css"):
        assert not re.search(r"(?:url\([\"']?|@import [\"'])(?:https?:)?//", path.read_text()), path.name
