"""The pages themselves: length, links, plots, and the site that they make."""

import importlib.util
import re

import matplotlib.image
import pytest
from helpers.pages import DOCS, PAGES, REPOSITORY, pages, without_blocks
from helpers.tiny_fit import fit, run_folder, write_tiny_config


def test_the_readme_is_short():
    assert len((REPOSITORY / "README.md").read_bytes()) <= 8192


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


@pages
def test_pages_speak_of_the_project_only(page):
    text = page.read_text()
    assert re.findall(r"(?:/work/|/root/|/home/|/tmp/|pypi|\bissue \d|#\d)", text, re.I) == []


def script(name):
    """A script of ``docs/`` as a module."""
    spec = importlib.util.spec_from_file_location(name, DOCS / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_plots_are_drawn_from_the_data(tmp_path):
    plots = script("plots")
    plots.main(["--out", str(tmp_path)])
    drawn = {path.stem for path in tmp_path.glob("*.png")}
    assert drawn == set(plots.PLOTS)
    shown = re.findall(r"\]\((\w+)\.png\)", (DOCS / "results.md").read_text())
    assert drawn <= set(shown)
    assert all((DOCS / f"{name}.png").stat().st_size < 300_000 for name in shown)


def test_plots_and_tables_show_the_same_numbers():
    plots = script("plots")
    readme, results = ((REPOSITORY / name).read_text() for name in ("README.md", "docs/results.md"))
    scores = ("albedo_psnr", "roughness_psnr")
    ends = {row.get("room", name): row for name in ("patterns", "rooms") for row in plots.rows(name)}
    assert [room for room, row in ends.items() for key in scores if f" {row[key]} " not in results] == []
    cells = {cell.strip() for line in results.splitlines() if line.startswith("|") for cell in line.split("|")}
    shown = re.findall(r"\| ([\d.]+) dB ", readme)
    assert len(shown) >= 4
    assert set(shown) <= cells
    for room in plots.COMPARED:
        last = {row["method"]: row for row in plots.rows(f"methods_{room}")}
        assert {row[key] for row in last.values() for key in scores} <= cells
    assert {row["ms_per_step"] for row in plots.rows("cube")} <= cells


def test_curves_of_methods_are_drawn_where_there_are_some(tmp_path, monkeypatch):
    plots = script("plots")
    (tmp_path / "data").mkdir()
    for file in (DOCS / "data").glob("*.csv"):
        head, *lines = file.read_text().splitlines()
        if file.stem.startswith("methods_"):  # the same methods half way, and another seed
            earlier = [line.replace(",0,600,", ",0,300,") for line in lines]
            lines = [*earlier, *lines, *(line.replace(",0,600,", ",1,600,") for line in lines)]
        (tmp_path / "data" / file.name).write_text("\n".join([head, *lines]) + "\n")
    monkeypatch.setattr(plots, "DOCS", tmp_path)
    monkeypatch.setattr(plots, "PLOTS", {})
    plots.main(["--out", str(tmp_path)])
    assert (tmp_path / "methods_curves.png").stat().st_size > 10_000


@pytest.mark.main
def test_the_picture_of_the_readme_is_made_of_a_run(tiny, capsys):
    write_tiny_config(base="kitchen.yaml")
    fit("--trainer.max_steps=2")
    picture = script("picture")
    picture.main([str(run_folder()), "--spp", "1", "--out", str(tiny / "kitchen.png")])
    assert "lamps" in capsys.readouterr().err  # what is lit differently is said
    pixels = matplotlib.image.imread(tiny / "kitchen.png")
    assert pixels.shape == matplotlib.image.imread(DOCS / "images" / "kitchen.png").shape
    assert (DOCS / "images" / "kitchen.png").stat().st_size < 400_000


def test_the_site_loads_nothing_from_elsewhere(tmp_path):
    pytest.importorskip("mkdocs", reason="needs mkdocs (extra docs)")
    from mkdocs.commands.build import build
    from mkdocs.config import load_config

    build(load_config(str(REPOSITORY / "mkdocs.yml"), site_dir=str(tmp_path), strict=True))
    built = sorted(tmp_path.rglob("*.html"))
    assert len(built) >= len(PAGES) - 2
    for path in built:
        loaded = re.findall(r"(?:\bsrc=|<link[^>]*href=)[\"'](https?:)?//", path.read_text())
        assert loaded == [], path.name
    for path in tmp_path.rglob("*.css"):
        assert not re.search(r"(?:url\([\"']?|@import [\"'])(?:https?:)?//", path.read_text()), path.name
