"""``neurad compare``: from command line to report, over made-up runs, and once over real ones."""

import csv
import json
import math
import os
import re
import signal
import subprocess
import sys
import time
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
import yaml
from browser import LAPTOP
from helpers import tiny_fit
from helpers.tables import csv_rows

from neurad.cli import main
from neurad.compare import curves, page, views
from neurad.compare import table as table_of
from neurad.compare.run import PLAIN, WARM_UP, print_configs, time_limit
from neurad.compare.runs import Run, full_name, marks, read_other, read_run, samples_per_step, stages
from neurad.core.errors import InputError
from neurad.images.image_io import write_exr
from neurad.runs import child
from neurad.runs.configs import load_config
from neurad.training.inverse import InverseRenderer

CONFIG = {
    "seed_everything": 0,
    "data": {"root": None, "scene": "nowhere", "patches": 4, "patch_size": 2},
    "model": {"sampling": {"spp": 8, "samples_per_vertex": 2}, "objective": {"estimator": "leave_one_out"}},
}
PER_STEP = 4 * 4 * 8 * 2
COLUMNS = ("iteration", "seconds", "rays", "psnr_srgb", "albedo_psnr", "albedo_mape")
CONSTANT = {"psnr_srgb_constant": 10.0, "albedo_psnr_constant": 15.0, "albedo_mape_constant": 0.5}

# A stand-in for the program: writes a run as `neurad fit` does, in no time, or fails as the overlay's name says.
STUB = """
import sys
from pathlib import Path
words = dict(word.partition("=")[::2] for word in sys.argv[2:])
if "bad.yaml" in sys.argv[3]:
    print("Traceback ...\\nneurad: error: the sky is green", file=sys.stderr)
    raise SystemExit(2)
run = Path(words["--trainer.default_root_dir"]) / "lightning_logs" / "version_0"
run.mkdir(parents=True)
(run / "config.yaml").write_text({config!r})
(run / "metrics.csv").write_text("iteration,seconds,rays,samples,albedo_psnr\\n1000,5,9,1000,20\\n3000,7,9,3000,25\\n")
(run.parents[1] / "arguments.txt").write_text("\\n".join(sys.argv[1:]))
"""


@pytest.fixture(autouse=True)
def _place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def stub(monkeypatch):
    """Children that only pretend."""
    Path("stub.py").write_text(STUB.format(config=yaml.safe_dump(CONFIG)))
    monkeypatch.setattr(child, "NEURAD", [sys.executable, str(Path("stub.py").resolve())])
    monkeypatch.setattr("neurad.compare.run.resolved_configs", lambda fits: [CONFIG for _ in fits])
    for name in ("scene", "good", "bad"):
        Path(f"{name}.yaml").write_text("{}\n")


def make_run(folder, psnr, seconds=(10, 20, 40), **changes):
    """A run folder with an evaluation at each of ``seconds``; 100 iterations and 5000 rays a second."""
    folder = Path(folder)
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text(yaml.safe_dump(CONFIG | changes))
    with (folder / "metrics.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([*COLUMNS, *CONSTANT])
        for s, p in zip(seconds, psnr, strict=True):
            writer.writerow([100 * s, s, 5000 * s, p, p, 10 ** (-p / 20), *CONSTANT.values()])
    return folder


def table(out="report"):
    return {row["method"]: row for row in csv_rows(Path(out) / "table.csv")}


# ---- finished runs


def test_table_of_finished_runs():
    make_run("a", (19.0, 23.0, 27.0))
    make_run("b", (18.0, 18.5, 19.9))
    main(["compare", "ours=a", "<&>=b"])
    rows = table()
    assert list(rows) == ["ours", "<&>", "best constant"]
    ours = rows["ours"]
    assert (ours["seconds"], ours["albedo_psnr"], ours["samples"]) == ("40", "27", str(4000 * PER_STEP))
    assert [ours[f"seconds_to_albedo_{v}"] for v in (20, 22, 24, 26, 28, 30)] == ["20", "20", "40", "40", "", ""]
    assert (ours["ms_per_step"], ours["rays_per_second"]) == ("10", "5000")
    assert float(ours["samples_per_second"]) == 100 * PER_STEP
    assert ours["peak_memory_mib"] == ours["roughness_psnr"] == ""
    assert rows["<&>"]["seconds_to_albedo_20"] == ""
    assert (rows["best constant"]["albedo_psnr"], rows["best constant"]["albedo_mape"]) == ("15", "0.5")
    lines = Path("report/table.md").read_text().splitlines()
    assert lines[0].split("|")[1].strip() == "method"
    assert len({line.count("|") for line in lines[:5]}) == 1
    points = [row for row in csv_rows("report/curves.csv") if row["method"] == "ours"]
    assert [row["seconds"] for row in points] == ["10", "20", "40"]
    assert set(COLUMNS) | set(CONSTANT) | {"method", "seed", "samples"} == set(points[0])
    assert points[1]["samples"] == str(2000 * PER_STEP)
    text = Path("report/index.html").read_text()
    # Albedo and picture against time, iterations and samples; MAPE of albedo against time and samples.
    assert text.count('<figure class="chart">') == 8
    outside = r'(?:src|href)="(?!data:|#)|(?<!xmlns=")(?<!xmlns:xlink=")https?://|url\((?!#)'
    assert not re.findall(outside, text)
    assert "&lt;&amp;&gt;" in text
    assert "<&>" not in text


def staged(**changes):
    """A run's settings with every stage but those that are changed."""
    roughness = {"begin": "best", "structure": "auto"} | changes.pop("roughness", {})
    model = {"roughness": roughness, "diffuse_lobe": "auto", "metallic": {"recover": "auto"}} | changes
    return {"model": CONFIG["model"] | model, "data": CONFIG["data"] | {"validation_pixels": 0.03}}


def test_the_table_says_which_stages_are_behind_a_method():
    make_run("a", (19.0, 23.0, 27.0), **staged())
    make_run("b", (18.0, 18.5, 19.9), **staged(roughness={"structure": "free"}, diffuse_lobe="files"))
    make_run("c", (18.0, 18.5, 19.9))  # of settings that do not say
    main(["compare", "a", "b", "c"])
    assert [row["stages"] for row in table().values()] == [
        "all",
        "where roughness begins, metals, filter of levels",
        "",
        "",
    ]
    assert "different stages behind them" in Path("report/index.html").read_text()
    main(["compare", "a", "c", "--out", "same"])
    assert "different stages behind them" not in Path("same/index.html").read_text()


def test_what_is_made_after_an_abstract_says_so_in_every_figure():
    """Whatever a run of it is called, and where a figure has short names."""
    guessed = "after Zhang et al. 2026, from the abstract"
    method = {"method": {"class_path": load_config("methods/blend.yaml")[-1].model.method.class_path}}
    make_run("a", (19.0, 23.0, 27.0))
    make_run("b", (18.0, 18.5, 19.9), model=CONFIG["model"] | method)
    main(["compare", "ours=a", "b"])
    assert list(table())[:2] == ["ours", f"b ({guessed})"]
    main(["compare", "ours=a", "blend=b", "--overwrite"])
    assert list(table())[:2] == ["ours", "blend"]
    assert guessed in full_name("blend")
    columns = {"truth": {}, "blend": {"albedo": np.zeros((8, 8, 3), np.float32)}}
    assert any(guessed in note for note in views.sheet(views.ComparedView("View 000", columns, 1.0)).notes)


def test_plain_fits_have_no_stage(stub):
    main(
        ["compare", "--config", "scene.yaml", "--methods", "good.yaml", "--samples", "4096", "--plain", "--views", "0"]
    )
    arguments = Path("report/runs/good_0/arguments.txt").read_text().splitlines()
    with redirect_stdout(StringIO()) as out:
        print_configs(json.dumps([["--config=kitchen.yaml", *PLAIN], ["--config=kitchen.yaml"]]))
    plain, usual = json.loads(out.getvalue())
    assert set(PLAIN) < set(arguments)
    assert (stages(plain), stages(usual)) == ("none", "all")


def test_marks_stand_below_the_methods_where_runs_have_them():
    rows = [{"roughness_psnr_constant": 21.0, "roughness_psnr_lookup": 31.4, "roughness_mape_lookup": 0.1}]
    run = Run("ours", 0, Path("a"), rows=rows)
    assert marks([run]) == {
        "best constant": {"roughness_psnr": 21.0},
        "true colour's lookup": {"roughness_psnr": 31.4, "roughness_mape": 0.1},
    }
    assert marks([Run("ours", 0, Path("a"), rows=[{"albedo_psnr": 20.0}])]) == {}


def test_what_is_exact_is_called_so_and_is_best():
    make_run("a", (19.0, 23.0, 27.0))
    make_run("b", (19.0, 23.0, math.inf))
    text = Path("b/metrics.csv").read_text()
    Path("b/metrics.csv").write_text(text.replace(",inf,", ",exact,"))  # as a run writes it
    main(["compare", "a", "b"])
    assert table()["b"]["albedo_psnr"] == "exact"
    written = [Path("report", name).read_text() for name in ("index.html", "table.md", "curves.csv")]
    assert "b has the best albedo (exact, the best constant 15.00)" in written[0]
    assert not re.search(r"\b(inf|nan)\b", "".join(written))


def test_seeds_of_a_method_make_one_row_and_a_band():
    for seed, psnr in enumerate(((20.0, 22.0, 24.0), (21.0, 25.0, 29.0), (19.0, 19.5, 21.0))):
        make_run(f"report/runs/ours_{seed}", psnr, seed_everything=seed)
        facts = {"method": "ours", "seed": seed, "peak_memory_mib": 100.0 * (seed + 1)}
        Path(f"report/runs/ours_{seed}/compare.json").write_text(json.dumps(facts))
    main(["compare", "report"])  # a report may be made anew from its own runs
    row = table()["ours"]
    assert (row["seeds"], row["albedo_psnr"], row["peak_memory_mib"]) == ("3", "24", "200")
    assert row["seconds_to_albedo_20"] == "10"  # 10, 10 and 40
    assert row["seconds_to_albedo_24"] == "40"  # 40, 20 and never
    assert row["seconds_to_albedo_26"] == ""  # one of three
    # By hand, at the geometric mean of 10 and 40: the middle evaluation.
    pairs = [curves.curve(read_run(Path(f"report/runs/ours_{i}")), "seconds", curves.PANELS[0]) for i in range(3)]
    at, middle, low, high = curves.band(pairs)
    index = int(np.argmin(np.abs(at - 20.0)))
    np.testing.assert_allclose([middle[index], low[index], high[index]], (22.0, 19.5, 25.0), atol=0.3)
    assert (low <= middle).all()
    assert (middle <= high).all()
    drawn = Path("report/curves_psnr.svg").read_text()
    assert drawn.count('id="FillBetweenPolyCollection') == 4  # albedo and picture, against seconds and iterations


def test_figures_are_vectors_of_a_page_s_width_and_equal_runs_make_equal_files():
    make_run("a", (19.0, 23.0, 27.0))
    make_run("b", (18.0, 19.0, 20.0))
    main(["compare", "ours=a", "prb=b"])
    first = {name: Path("report", name).read_bytes() for name in ("curves_psnr.svg", "curves_psnr.pdf")}
    main(["compare", "ours=a", "prb=b", "--overwrite"])
    assert first == {name: Path("report", name).read_bytes() for name in first}
    svg = first["curves_psnr.svg"].decode()
    words = re.findall(r"<!-- (.*?) -->", svg)  # what letters are drawn as paths
    assert {"Radiometric prior (ours)", "Path replay (PRB)", "best constant"} <= set(words)
    assert {"training time / s", "iterations"} <= set(words)
    assert float(re.search(r'<svg [^>]*width="([\d.]+)pt"', svg)[1]) <= 7.0 * 72 + 0.1
    assert b"/Subtype /Type3" not in first["curves_psnr.pdf"].replace(b"/Subtype/Type3", b"/Subtype /Type3")


def test_crops_are_where_methods_are_most_wrong_and_have_their_error_in_a_corner(monkeypatch):
    exact = np.full((32, 48, 3), 0.5, np.float32)
    wrong = exact.copy()
    wrong[20:28, 30:38] += 0.4
    columns = {"truth": {"albedo": exact}, "ours": {"albedo": exact}, "prb": {"albedo": wrong}}
    pages = []
    monkeypatch.setattr(views, "save", lambda page, stem: pages.append(page))
    views.write_crops(Path("crops"), columns, 1.0)
    whole, truth, ours, prb = pages[0].axes[:4]
    assert [ax.get_title() for ax in (whole, truth, ours)] == ["Held-out view", "Truth", "Radiometric prior (ours)"]
    assert (ours.get_xlabel(), prb.get_xlabel()) == ("exact", "8.0 dB")  # the square has 8 x 8 pixels, 0.4 too bright
    inset = prb.child_axes[0].images[0].get_array()
    assert (inset == inset[0, 0]).all()
    assert ours.child_axes[0].images[0].get_array().max() < 30 < inset.max()
    views.write_crops(Path("none"), {"truth": {}, "ours": {"albedo": exact}}, 1.0)
    assert len(pages) == 1


def test_equal_folder_names_are_no_seeds():
    make_run("x/version_0", (20.0, 20.0, 20.0))
    make_run("y/version_0", (21.0, 21.0, 21.0))
    main(["compare", "x/version_0", "y/version_0"])
    assert list(table())[:2] == ["x/version_0", "y/version_0"]


def test_own_samples_column_wins():
    folder = make_run("a", (20.0,), seconds=(10,))
    (folder / "metrics.csv").write_text("iteration,seconds,samples\n5,1,77\n7,2,\n")
    run = read_run(folder)
    assert [row["samples"] for row in run.rows] == [77, 7 * PER_STEP]
    twice = CONFIG | {"model": CONFIG["model"] | {"objective": {"estimator": "two_pass"}}}
    assert samples_per_step(twice) == 2 * PER_STEP
    assert samples_per_step({"data": {"patches": 3}}) is None


def test_the_page_fits_a_laptop(look_at):
    """With every column of the table, long labels, and pictures."""
    names = table_of.columns((20.0, 30.0))
    row = {name: 12345.678 for name in names} | {"seeds": 3.0, "status": "ok"}
    rows = [row | {"method": "lightning_logs/of_some_longer_name/version_12"}, row | {"method": "prb"}]
    one = np.full((8, 8, 3), 0.5, np.float32)
    columns = {"truth": {"albedo": one}, "a": {"albedo": one}, "b": {"albedo": one}}
    sheet = views.sheet(views.ComparedView("View 000", columns, 1.0))
    drawn = [{"seconds": s, "samples": s, "albedo_psnr": s} for s in (5.0, 7.0, 9.0)]
    runs = [Run("prb", 0, Path("a"), rows=drawn)]
    page.write_page(Path("index.html"), "A page", [], rows, (20.0, 30.0), runs, [sheet])
    seen = look_at(Path("index.html"), offline=True)
    assert seen.width() == (LAPTOP[0], LAPTOP[0])
    wide = "[...document.querySelectorAll('.scroll')].filter(box => box.scrollWidth > box.clientWidth).length"
    assert seen.page.evaluate(wide) == 0  # no table has to be scrolled sideways
    assert [seen.page.locator(what).count() for what in ("table", ".slider", "details")] == [3, 1, 1]
    assert (seen.errors, seen.network) == ([], [])
    first = seen.page.locator("table").first.inner_text()
    assert "albedo PSNR / dB \u2191" in first
    assert "albedo MAPE \u2193" in first


def test_the_headline_says_who_is_best_and_what_nobody_found():
    scored = {"seeds": 1.0, "albedo_psnr": 20.0, "roughness_psnr": 9.0}
    rows = [{"method": "a", **scored}, {"method": "b", **scored, "albedo_psnr": 21.0}]
    rows.append({"method": "best constant", "albedo_psnr": 15.0, "roughness_psnr": 10.0})
    text = page.headline(rows)
    assert text.startswith(
        "On the held-out views b has the best albedo (21.00 dB, the best constant 15.00); no method has roughness above"
    )
    both = [rows[0], {**rows[1], "roughness_psnr": 12.0}, rows[2]]
    assert page.headline(both) == (
        "On the held-out views b has the best albedo (21.00 dB, the best constant 15.00) and roughness (12.00 dB, the "
        "best constant 10.00)."
    )
    three = page.headline([rows[0], {**both[1], "psnr_srgb": 30.0}])
    assert "best albedo (21.00 dB), roughness (12.00 dB) and picture (30.00 dB)." in three
    assert (
        page.headline([{"method": "a", "seeds": 0.0, "status": "failed"}])
        == "On the held-out views nothing was scored."
    )


# ---- bad input


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["nowhere"], "nowhere"),
        (["empty"], "config.yaml is missing"),
        (["torn"], "torn/metrics.csv"),
        (["good", "--methods", "ours"], "--methods"),
        (["good", "--data.root", "x"], "--data.root"),
        (["good", "--reach", "much"], "--reach much"),
        (["good", "--out", "full"], "--overwrite"),
        (["good", "--run", "peer"], "it has to be NAME=DIR"),
        (["good", "--run", "a=nowhere"], "there is no such folder"),
        (["good", "--run", "a=empty"], "neither metrics.csv nor maps"),
        ([], "--config"),
        (["--config", "kitchen.yaml", "--budget", "1"], "--methods"),
        (["--config", "kitchen.yaml", "--methods", "nothing", "--budget", "1"], "methods/nothing.yaml"),
        (["--config", "nothing.yaml", "--methods", "ours", "--budget", "1"], "nothing.yaml"),
        (["--config", "kitchen.yaml", "--methods", "ours"], "--budget"),
        (["--config", "kitchen.yaml", "--methods", "ours", "--budget", "1", "--samples", "1"], "--samples"),
        (["--config", "kitchen.yaml", "--methods", "ours", "--budget", "-1"], "--budget"),
        (["--config", "kitchen.yaml", "--methods", "ours,ours", "--budget", "1"], "same name"),
        (["--config", "kitchen.yaml", "--methods", "ours", "--budget", "1", "--seeds", "a"], "--seeds a"),
        (["--config", "kitchen.yaml", "--methods", "ours", "--budget", "1", "--out", "full"], "--overwrite"),
    ],
)
def test_bad_input_is_one_sentence_and_leaves_nothing(capfd, words, said):
    make_run("good", (20.0, 21.0, 22.0))
    (make_run("torn", (20.0,), seconds=(1,)) / "metrics.csv").write_text("iteration,seconds\n1,soon\n")
    Path("empty").mkdir()
    Path("full").mkdir()
    Path("full/mine.txt").write_text("mine")
    assert said in tiny_fit.fails(capfd, "compare", *words)


def test_an_unknown_setting_is_found_before_the_first_fit(capfd, monkeypatch):
    """In the words of the fit, which a child prints."""
    with pytest.raises(InputError, match=r"command line: model\.rat is not a known setting"):
        print_configs(json.dumps([["--config=cornell.yaml", "--model.rat=3"]]))
    said = "import sys; print('neurad: error: model.rat is odd', file=sys.stderr); sys.exit(2)"
    monkeypatch.setattr(child, "NEURAD", [sys.executable, "-c", said])
    words = ["--config", "cornell.yaml", "--methods", "ours", "--budget", "1", "--model.rat=3"]
    assert "model.rat is odd" in tiny_fit.fails(capfd, "compare", *words)


# ---- runs to be made


def test_fits_of_few_iterations_are_marked_and_never_best():
    make_run("a", (19.0, 23.0), seconds=(10, 20))
    make_run("b", (20.0, 29.0), seconds=(0.3, 0.9))  # 90 iterations
    main(["compare", "a", "b"])
    rows = table()
    assert [(rows[name]["iterations"], rows[name]["status"]) for name in ("a", "b")] == [
        ("2000", "ok"), ("90", "too few iterations (seed 0)")
    ]  # fmt: skip
    written = Path("report/index.html").read_text()
    assert "a has the best albedo (23.00 dB" in written
    assert '<span class="best">29.00</span>' not in written
    assert "b: too few iterations (seed 0)</p>" in written
    main(["compare", "b", "--out", "alone"])
    assert "On the held-out views every fit did too few iterations." in Path("alone/index.html").read_text()


@pytest.mark.parametrize(("name", "deaf"), [("SIGTERM", False), ("SIGINT", False), ("SIGHUP", False), ("SIGINT", True)])
def test_a_child_ends_with_who_started_it(tmp_path, name, deaf):
    if not hasattr(signal, name):
        pytest.skip("the system has no such signal")
    stubborn = "import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN);" if deaf else ""
    code = f"""
import signal, sys
from pathlib import Path
from neurad.runs import child
from neurad.runs.configs import load_config
signal.signal(signal.{name}, signal.SIG_DFL)  # who runs the tests may have it ignored
signal.signal(signal.SIGINT, signal.default_int_handler)
child.PATIENCE = 0.2
child.NEURAD = [sys.executable, "-c", "{stubborn}import os, time; print(os.getpid(), flush=True); time.sleep(60)"]
child.run_neurad([], Path("log"))
"""
    parent = subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.PIPE)
    log, end = Path("log"), time.monotonic() + 30
    while not (log.is_file() and log.read_text().endswith("\n")) and time.monotonic() < end:
        time.sleep(0.02)
    parent.send_signal(getattr(signal, name))
    parent.communicate(timeout=30)
    expected = -signal.SIGINT if name == "SIGINT" else 128 + getattr(signal, name)
    assert parent.returncode == expected
    with pytest.raises(ProcessLookupError):
        os.kill(int(log.read_text()), 0)


def test_a_failed_run_does_not_lose_the_others(stub, capfd):
    words = ["--config", "scene.yaml", "--methods", "bad.yaml,good.yaml", "--budget", "2.5", "--seeds", "3,1"]
    with pytest.raises(SystemExit) as stop:
        main(["compare", *words, "--data.root", "DIR"])
    assert stop.value.code == 1
    assert "bad (seed 3), bad (seed 1)" in capfd.readouterr().err
    rows = table()
    assert rows["bad"]["status"] == "failed (seed 3): the sky is green; failed (seed 1): the sky is green"
    assert (rows["bad"]["seeds"], rows["bad"]["seconds"]) == ("0", "")
    assert (rows["good"]["seeds"], rows["good"]["albedo_psnr"], rows["good"]["status"]) == ("2", "25", "ok")
    assert float(rows["good"]["peak_memory_mib"]) > 1
    assert float(rows["good"]["processor_seconds"]) > 0
    assert "the sky is green" in Path("report/index.html").read_text()
    run = Path("report/runs/good_3")
    assert not (run / "lightning_logs").exists()
    arguments = (run / "arguments.txt").read_text().splitlines()
    assert arguments[:3] == ["fit", "--config=scene.yaml", "--config=good.yaml"]
    assert "--data.root=DIR" in arguments
    assert "--seed_everything=3" in arguments
    assert "--trainer.max_time=3s" in arguments  # so that there is a limit; the budget below rules
    assert any(word.startswith("--trainer.callbacks+=") and '"seconds": 2.5' in word for word in arguments)


@pytest.mark.parametrize("every", [None, 7])
def test_samples_become_steps(stub, monkeypatch, every):
    settings = CONFIG | {"evaluation": {"every_n_steps": every}}
    monkeypatch.setattr("neurad.compare.run.resolved_configs", lambda fits: [settings])
    main(["compare", "--config=scene.yaml", "--methods=good.yaml", f"--samples={PER_STEP * 41}"])
    arguments = Path("report/runs/good_0/arguments.txt").read_text().splitlines()
    assert "--trainer.max_steps=41" in arguments
    assert "--trainer.max_time=null" in arguments
    # a curve needs points, and 41 steps are few; a schedule that was asked for stays
    assert [word for word in arguments if "every_n_steps" in word] == ["--evaluation.every_n_steps=2"] * (not every)


def test_overwrite_replaces_the_runs_but_nothing_else(stub):
    Path("report/runs/good_0").mkdir(parents=True)
    Path("report/runs/good_0/old.txt").write_text("old")
    Path("report/mine.txt").write_text("mine")
    main(["compare", "--config=scene.yaml", "--methods=good.yaml", "--budget=1", "--overwrite"])
    assert not Path("report/runs/good_0/old.txt").exists()
    assert Path("report/mine.txt").read_text() == "mine"


def test_peak_memory_is_that_of_one_child():
    """In a process of its own: on Linux a child begins with the peak of who starts it, and pytest is large."""
    code = """
import sys
from pathlib import Path
from neurad.runs import child
from neurad.runs.configs import load_config
for size in (200, 1):
    child.NEURAD = [sys.executable, "-c", f"b'x' * ({size} << 20)"]
    print(child.run_neurad([], Path("log")).peak_memory_mib)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    large, small = (float(word) for word in done.stdout.split())
    assert 200 < large < 260
    assert small < 60


def test_a_budget_counts_training_seconds(tiny, monkeypatch):
    """Evaluations that are slowed down by a quarter second each take nothing from the training time, and neither does a
    start that takes longer than the whole budget.
    """
    tiny_fit.fit("--trainer.max_steps=2")  # compiles what a first run would compile within its budget
    evaluate, slept = InverseRenderer.evaluate, []

    def slow(self, *args, **options):
        time.sleep(0.25)
        slept.append(0.25)
        return evaluate(self, *args, **options)

    monkeypatch.setattr(InverseRenderer, "evaluate", slow)
    start = InverseRenderer.on_fit_start
    monkeypatch.setattr(InverseRenderer, "on_fit_start", lambda self: (time.sleep(0.6), start(self)))
    begin = time.monotonic()
    tiny_fit.fit(*time_limit(0.5), WARM_UP, "--evaluation.every_n_steps=20")
    taken = time.monotonic() - begin
    run = read_run(Path("lightning_logs/version_1"))
    assert len(run.rows) == len(slept) >= 2
    assert 0.5 <= run.last["seconds"] < taken - sum(slept) - 0.6
    assert run.last["iteration"] > 20
    main(["fit", "--ckpt_path=last"])  # nothing is left of the budget
    assert read_run(Path("lightning_logs/version_1")).last["iteration"] == run.last["iteration"]


def test_a_real_method():
    """The whole way: cornell for a few steps, so many samples, pictures included; several runs are made up above."""
    tiny_fit.write_tiny_config(data={"patches": 32}, evaluation={"every_n_steps": 8})
    main(["compare", "--config=tiny.yaml", "--methods=ours", "--samples=2048", "--views=1", "--view-spp=1"])
    rows = table()
    assert list(rows) == ["ours", "best constant"]
    assert (rows["ours"]["samples"], rows["ours"]["status"]) == ("2048", "too few iterations (seed 0)")
    assert float(rows["ours"]["peak_memory_mib"]) > 100
    assert float(rows["ours"]["ms_per_step"]) > 0
    names = {path.name for path in Path("report/runs/ours_0").iterdir()}
    assert {"config.yaml", "metrics.csv", "checkpoints", "images", "compare.json", "output.txt"} <= names
    tables = {"index.html", "table.md", "table.csv", "curves.csv", "runs"}
    figures = ("curves_psnr", "curves_mape", "crops")
    pictures = {f"{name}.{suffix}" for name in figures for suffix in ("png", "pdf", "svg")} | {"view_000.png"}
    assert {path.name for path in Path("report").iterdir()} == tables | pictures


def test_what_another_program_found_stands_beside_a_run():
    """A curve alone, without iterations, and maps alone."""
    make_run("a", (19.0, 23.0, 27.0))
    Path("peer/albedo").mkdir(parents=True)
    Path("peer/metrics.csv").write_text("seconds,albedo_psnr\n5,20\n50,28\n")
    main(["compare", "ours=a", "--run", "FIPT=peer"])
    rows = table()
    assert list(rows)[:2] == ["ours", "FIPT"]
    assert (rows["FIPT"]["albedo_psnr"], rows["FIPT"]["seconds"], rows["FIPT"]["iterations"]) == ("28", "50", "")
    assert rows["FIPT"]["status"] == "ok"
    assert "FIPT" in Path("report/index.html").read_text()
    picture = np.full((4, 4, 3), 0.25, np.float32)
    write_exr("peer/albedo/first.exr", picture)
    Path("peer/metrics.csv").unlink()
    other = read_other("FIPT=peer")
    np.testing.assert_allclose(views.predicted(other, "first", 0)["albedo"], picture, atol=1e-3)
    assert views.predicted(other, "second", 1) == {}
