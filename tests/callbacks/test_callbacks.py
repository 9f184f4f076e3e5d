"""metrics.csv, closing tables, pictures and the clock."""

import json
import math
import os
import re
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.tiny_fit import fit, metrics, write_tiny_config
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from neurad.assembly.settings import EvaluationSettings
from neurad.callbacks import evaluation, pictures
from neurad.callbacks.closing import busy
from neurad.callbacks.evaluation import Evaluate
from neurad.callbacks.pictures import environments
from neurad.callbacks.report import write_report
from neurad.callbacks.table import MetricsTable, curve_table, score_table
from neurad.cli import main
from neurad.core.decibels import as_json
from neurad.images.image_io import read_bitmap, read_exr
from neurad.metrics.unseen import Unseen
from neurad.runtime import clock
from neurad.training import inverse, scoring
from neurad.training.evaluate import Evaluation
from neurad.training.schedule import Progress

CASES = Path(__file__).resolve().parents[3] / "shared" / "cases"


def row(iteration, **scores):
    return {"iteration": iteration, "seconds": iteration / 10, "rays": 7 * iteration, **scores}


def test_cut_drops_what_comes_after_the_checkpoint_and_half_a_line(tmp_path):
    table = MetricsTable(tmp_path / "metrics.csv")
    for iteration in (10, 20, 30):
        table.append(row(iteration, albedo_psnr=float(iteration)))
    whole = table.path.read_text()
    table.path.write_text(whole + "40,4.0,28")
    assert [r["iteration"] for r in table.rows()] == [10, 20, 30]
    table.cut(40)
    assert table.path.read_text() == whole
    table.cut(20)
    assert [r["iteration"] for r in table.rows()] == [10, 20]
    kept = table.path.read_text()
    table.append(row(30, albedo_psnr=0.123456))
    assert [r["iteration"] for r in table.rows()] == [10, 20, 30]
    table.path.write_text(table.path.read_text()[:-3])  # a line that lacks only its end: the value would read 0.123
    table.cut(30)
    assert table.path.read_text() == kept


def test_curve_shows_the_first_and_the_last_of_many():
    lines = curve_table([row(i, albedo_psnr=float(i)) for i in range(1, 101)]).splitlines()
    assert len(lines) == 9
    assert lines[1].split()[1] == "1"
    assert lines[-1].split()[1] == "100"
    assert curve_table([]) == ""


def test_tables_have_no_column_that_is_not_known():
    """Of a room without true maps pictures alone are scored."""
    scores = {"psnr_srgb": 21.4, "psnr_srgb_constant": 13.1}
    assert score_table(scores, 0).splitlines() == [
        "Held-out views, all pixels",
        "               image PSNR (sRGB)",
        "neurad                     21.40",
        "best constant              13.10",
    ]
    assert " ".join(curve_table([row(5, psnr_srgb=21.4)]).split()) == "seconds iteration image PSNR (sRGB) 0 5 21.40"


def views():
    ramp = np.linspace(0.0, 2.0, 30, dtype=np.float32).reshape(2, 5, 3)
    one = np.full((2, 5, 1), 0.4, np.float32)
    return [{"name": "a", "render": ramp + 0.1, "photograph": ramp, "albedo": ramp / 2, "roughness": one}]


def test_a_sheet_holds_what_there_is():
    sheet = pictures.view_sheet(views()[0], 0.5, "a")
    assert {label: [tile.key for tile in tiles] for label, tiles in sheet.rows.items()} == {
        "Picture": ["render", "photograph", "render_error"],
        "Albedo": ["albedo"],
        "Roughness": ["roughness"],
    }
    error = sheet.rows["Picture"][2]
    assert len(np.unique(error.picture.reshape(-1, 3), axis=0)) == 1  # the error is 0.1 everywhere
    assert "darker is better" in error.scale.meaning
    assert "Exposure: radiance times 0.5" in sheet.notes[0]
    assert sheet.unseen is None


def test_views_are_written_linear_and_for_looking_at(tmp_path):
    maps = views()
    maps[0]["seen"] = np.array([[[0.0], [0.5], [1.0], [1.0], [1.0]]] * 2, np.float32)
    pictures.write_views(tmp_path / "images", maps, 1.0)
    names = {f"a_{kind}.{end}" for kind in ("render", "albedo", "roughness") for end in ("exr", "png")}
    names |= {"a_seen.png", "a_sheet.png"}
    assert {p.name for p in (tmp_path / "images").iterdir()} == names
    for kind in ("render", "albedo", "roughness"):
        np.testing.assert_array_equal(read_exr(tmp_path / "images" / f"a_{kind}.exr"), maps[0][kind])
    assert read_bitmap(tmp_path / "images" / "a_seen.png", raw=True)[0, :3, 0].tolist() == pytest.approx(
        [0, 128 / 255, 1]
    )


def test_the_clock_stands_still_during_evaluation():
    clock.restart()
    with clock.excluded():
        time.sleep(0.05)
        inside = clock.training_seconds()
        time.sleep(0.05)
        assert clock.training_seconds() == inside
    assert clock.training_seconds() < 0.05


def test_processor_time_stands_still_during_evaluation_and_is_nothing_while_it_is_held(monkeypatch):
    now = [10.0, 1.0]
    monkeypatch.setattr(clock, "_processor", lambda: tuple(now))
    clock.hold()
    assert (clock.training_seconds(), clock.processor_seconds()) == (0.0, (0.0, 0.0))
    clock.restart()
    now[:] = 13.0, 2.0
    with clock.excluded():
        now[:] = 20.0, 7.0
        assert clock.processor_seconds() == (3.0, 1.0)
    now[:] = 21.0, 9.0
    assert clock.processor_seconds() == (4.0, 3.0)


@pytest.mark.skipif(not Path("/proc/self/schedstat").exists(), reason="the system does not report it")
def test_waiting_for_a_processor_that_something_else_has_is_noticed():
    usable = os.sched_getaffinity(0)
    one = {min(usable)}
    code = f"import os\nos.sched_setaffinity(0, {one})\nprint(flush=True)\nwhile True: pass"
    other = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
    try:
        other.stdout.readline()
        os.sched_setaffinity(0, one)
        clock.restart()
        end = time.monotonic() + 0.5
        while time.monotonic() < end:
            pass
        used, waited = clock.processor_seconds()
    finally:
        other.kill()
        other.wait()
        os.sched_setaffinity(0, usable)
    assert used + waited == pytest.approx(0.5, abs=0.2)
    assert waited > 0.1


def test_the_end_of_a_fit_says_what_it_got_of_a_busy_processor():
    module = SimpleNamespace(iteration=285, spent=SimpleNamespace(seconds=240.2, processor_share=0.28))
    assert busy(module).startswith("285 iterations in 240 s: the fit got 28 % of the processor time that it asked for")
    assert busy(SimpleNamespace(spent=SimpleNamespace(processor_share=0.88))) == ""


def test_when_evaluations_are_due(monkeypatch):
    """The second one as long after the first as that was after the start, the others as time allows."""
    callback, now = Evaluate(EvaluationSettings(fraction=0.2)), {"mark": 0}
    module = SimpleNamespace(iteration=0, spent=SimpleNamespace(seconds=0.0))
    trainer = SimpleNamespace(max_steps=-1, callbacks=[], global_step=0)
    monkeypatch.setattr(Evaluate, "_mark_of", staticmethod(lambda _: now["mark"]))
    due: list[int] = []
    for mark in range(20):  # of 12 seconds each; the first evaluation ends at the second mark
        now["mark"], module.spent.seconds = mark, 12.0 * mark
        if callback._due(trainer, module):
            callback._count(8.0 if due else 30.0)
            due.append(mark)
            now["mark"] = callback._mark = mark + (1 if mark == 1 else 0)
    assert due == [1, 4, 10, 14, 17]


def test_what_is_exact_is_called_so_in_tables_files_and_pages(tmp_path):
    scores = {"albedo_psnr": 30.0, "albedo_psnr_constant": 15.0, "albedo_mape": 0.1, "albedo_mape_constant": 0.4}
    scores |= {"roughness_psnr": 26.0, "roughness_psnr_constant": math.inf, "roughness_psnr_lookup": math.inf}
    table = MetricsTable(tmp_path / "metrics.csv")
    for iteration in (1, 2):
        table.append({"iteration": iteration, "seconds": iteration, "rays": 1, "samples": 1, **scores})
    assert table.rows()[-1]["roughness_psnr_constant"] == math.inf
    write_report(tmp_path / "report.html", "a run", Evaluation(scores, []), Unseen([]), rows=table.rows())
    page = (tmp_path / "report.html").read_text()
    assert "best constant: exact</text>" in page  # in the key of the chart, as no axis has a place for it
    said = score_table(scores | {"roughness_psnr": math.inf}, 0)
    said += curve_table([table.rows()[0] | {"albedo_psnr": math.inf}])
    assert said.count("exact") == 4
    written = [page, said, (tmp_path / "metrics.csv").read_text()]
    assert not re.search(r"\b(inf|nan|infinity)\b", " ".join(written), re.I)
    assert json.dumps([as_json(x) for x in (1.5, math.inf, math.nan)]) == '[1.5, "exact", null]'


def test_a_sky_a_thousand_times_as_bright_as_the_room_is_no_white_picture(tmp_path):
    sky = np.full((8, 16, 3), 1000.0, np.float32)
    sky[:, :8] *= 0.25
    pictures = environments({"fitted": sky})
    assert [*pictures] == ["Recovered environment"]
    assert len(np.unique(pictures["Recovered environment"])) == 2
    brighter = environments({"fitted": 2.0 * sky, "truth": sky})  # at one exposure, which no fit changes
    np.testing.assert_array_equal(brighter["Environment of the scene file"], pictures["Recovered environment"])
    result = Evaluation({}, [], environment={"fitted": sky, "truth": sky})
    write_report(tmp_path / "report.html", "a run", result, Unseen([]))
    assert (tmp_path / "report.html").read_text().count('class="tile"') == 2


@pytest.mark.skipif(not (CASES / "one_roughness").is_dir(), reason="the shared cases are not here")
def test_a_room_whose_roughness_colour_tells_ends_with_a_report(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    limits = ["--trainer.max_time=null", "--trainer.max_steps=3", "--trainer.accelerator=cpu"]
    main(["fit", "--config", "scene.yaml", f"--data.root={CASES / 'one_roughness'}", *limits])
    run = Path("lightning_logs/version_0")
    assert "true colour's lookup: exact" in (run / "report.html").read_text()
    assert MetricsTable(run / "metrics.csv").rows()[-1]["roughness_psnr_lookup"] == math.inf
    assert [path.name for path in run.glob("one_roughness-*")] == ["one_roughness-radiometric"]
    events = EventAccumulator(str(run / "one_roughness-radiometric")).Reload()
    assert len(events.Images("fit/roughness_psnr_chart")) == 1


def test_every_score_is_of_factors_of_the_levels_that_were_just_fitted(tmp_path, monkeypatch):
    """What is shown of a run depends on these factors, so every row has to come after them; the end is scored once."""
    calls = []
    update, score = inverse.show_levels, scoring.evaluate

    def updated(training, progress):
        calls.append(("levels", training.counters.iteration))
        return update(training, progress)

    def scored(*args):
        calls.append("scores")
        return score(*args)

    monkeypatch.setattr(inverse, "show_levels", updated)
    monkeypatch.setattr(scoring, "evaluate", scored)
    monkeypatch.chdir(tmp_path)
    write_tiny_config(trainer={"max_steps": 4}, evaluation={"every_n_steps": 2})
    fit()
    assert calls == [("levels", 2), "scores", ("levels", 4), "scores"]
    assert [row["iteration"] for row in metrics()] == ["2", "4"]


def test_an_evaluation_that_outlasts_the_time_of_a_fit_is_made_again_as_its_end(tmp_path, monkeypatch):
    """Lightning's timer counts evaluations; plain paint is found where a fit ends, and nowhere else."""
    ends, score, find = [], scoring.evaluate, scoring.Scoring.find_paint

    def slow(*args):
        time.sleep(1.2)
        return score(*args)

    def found(self, as_end):
        ends.append(as_end)
        find(self, as_end)

    monkeypatch.setattr(scoring, "evaluate", slow)
    monkeypatch.setattr(scoring.Scoring, "find_paint", found)
    monkeypatch.chdir(tmp_path)
    write_tiny_config(trainer={"max_steps": -1, "max_time": "00:00:00:01"}, evaluation={"every_n_steps": 1})
    fit()
    assert ends == [False, False, True]  # before, after the first iteration, and the end
    assert [row["iteration"] for row in metrics()] == ["1"]


def test_no_evaluation_takes_the_last_of_a_fits_time(monkeypatch):
    callback, left = Evaluate(EvaluationSettings(fraction=1.0)), {"seconds": 100.0}
    module = SimpleNamespace(iteration=0, spent=SimpleNamespace(seconds=500.0))
    trainer = SimpleNamespace(max_steps=-1, callbacks=[], global_step=0)
    monkeypatch.setattr(evaluation, "fraction_done", lambda _: Progress(None, 1.0 - left["seconds"] / 600.0, 600.0))
    for taken in (20.0, 20.0):
        callback._count(taken)
    assert callback._due(trainer, module)
    left["seconds"] = 30.0  # 10 of them would be left
    callback._mark = 0
    assert not callback._due(trainer, module)
