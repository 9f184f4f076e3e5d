"""metrics.csv, closing tables, pictures and the clock."""

import time
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.tiny_fit import fit, metrics, write_tiny_config

from neurad.callbacks import pictures
from neurad.callbacks.board import split_mark
from neurad.callbacks.evaluation import Evaluate
from neurad.callbacks.table import COLUMNS, MetricsTable, curve_table, score_table
from neurad.runtime import clock
from neurad.runtime.tables import read_header
from neurad.scene.image_io import read_bitmap, read_exr
from neurad.training import scoring
from neurad.training.stages import LevelFilter


def row(iteration, **scores):
    return {"iteration": iteration, "seconds": iteration / 10, "rays": 7 * iteration, **scores}


def test_rows_come_back_as_written(tmp_path):
    table = MetricsTable(tmp_path / "metrics.csv")
    table.append(row(10, albedo_psnr=20.5, albedo_psnr_8x8=22.0))
    table.append(row(20, albedo_psnr=21.5, unheard_of=1.0))
    assert read_header(table.path) == [*COLUMNS, "albedo_psnr_8x8"]
    assert table.rows() == [row(10, albedo_psnr=20.5, albedo_psnr_8x8=22.0), row(20, albedo_psnr=21.5)]


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
    table.append(row(30))
    assert [r["iteration"] for r in table.rows()] == [10, 20, 30]


def test_a_line_that_lacks_only_its_end_is_cut(tmp_path):
    table = MetricsTable(tmp_path / "metrics.csv")
    table.append(row(10, roughness_mape_seen=0.25))
    whole = table.path.read_text()
    table.append(row(20, roughness_mape_seen=0.123456))
    table.path.write_text(table.path.read_text()[:-3])  # the last value would read 0.1234
    table.cut(20)
    assert table.path.read_text() == whole


def test_cut_without_a_file_makes_none(tmp_path):
    MetricsTable(tmp_path / "metrics.csv").cut(5)
    assert list(tmp_path.iterdir()) == []


def test_closing_table_has_the_best_constant_beside_every_region():
    text = score_table({"albedo_psnr": 30.123, "albedo_psnr_constant": 15.2, "albedo_psnr_seen": 31.0}, spp=4)
    lines = text.splitlines()
    assert len({len(line) for line in lines[1:4]}) == 1  # heading, neurad, best constant
    assert sum(line.startswith("neurad") and "30.12" in line for line in lines) == 1
    assert sum(line.startswith("best constant") and "15.20" in line for line in lines) == 1
    assert "31.00" in text
    assert "4 samples" in text


def test_curve_shows_the_first_and_the_last_of_many():
    lines = curve_table([row(i, albedo_psnr=float(i)) for i in range(1, 101)]).splitlines()
    assert len(lines) == 9
    assert lines[1].split()[1] == "1"
    assert lines[-1].split()[1] == "100"
    assert curve_table([]) == ""


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
    pictures.write_views(tmp_path / "images", maps)
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


def test_the_first_evaluation_counts_for_what_the_second_takes():
    """It compiles kernels where no cache has them, half a minute in a fresh environment."""
    callback = Evaluate(fraction=0.1)
    callback._count(30.0)
    again = Evaluate(fraction=0.1)
    again.load_state_dict(callback.state_dict())
    for interrupted in (callback, again):
        assert interrupted.state_dict() | {"spent": 0.0, "last": 0.0} == interrupted.state_dict()
        interrupted._count(2.0)
        interrupted._count(3.0)
        assert interrupted.state_dict() | {"spent": 7.0, "last": 3.0} == interrupted.state_dict()


def test_when_evaluations_are_due(monkeypatch):
    """The second one as long after the first as that was after the start, the others as time allows."""
    callback, now = Evaluate(fraction=0.2), {"mark": 0}
    module = SimpleNamespace(iteration=0, train_seconds=0.0)
    trainer = SimpleNamespace(max_steps=-1, callbacks=[], global_step=0)
    monkeypatch.setattr(Evaluate, "_mark_of", staticmethod(lambda _: now["mark"]))
    due: list[int] = []
    for mark in range(20):  # of 12 seconds each; the first evaluation ends at the second mark
        now["mark"], module.train_seconds = mark, 12.0 * mark
        if callback._due(trainer, module):
            callback._count(8.0 if due else 30.0)
            due.append(mark)
            now["mark"] = callback._mark = mark + (1 if mark == 1 else 0)
    assert due == [1, 4, 10, 14, 17]


def test_closing_table_has_the_lookup_by_colour_where_there_is_one():
    scores = {"roughness_psnr": 26.0, "roughness_psnr_constant": 21.0, "roughness_psnr_lookup": 31.4}
    lines = score_table(scores, 4).splitlines()
    assert [line.split()[-5] for line in lines[2:]] == ["26.00", "21.00", "31.40"]
    assert lines[-1].startswith("true colour's lookup")
    assert "lookup" not in score_table({"albedo_psnr": 30.0, "albedo_psnr_constant": 15.0}, 4)


def test_what_needs_no_fit_is_told_apart_from_the_run():
    assert split_mark("albedo_psnr_8x8_constant_seen") == ("best constant", "albedo_psnr_8x8_seen")
    assert split_mark("roughness_r2_lookup") == ("true colour's lookup", "roughness_r2")
    assert split_mark("albedo_psnr_seen") == (None, "albedo_psnr_seen")


def test_every_score_is_of_factors_of_the_levels_that_were_just_fitted(tmp_path, monkeypatch):
    """What is shown of a run depends on these factors, so every row has to come after them; the end is scored once."""
    calls = []
    update, score = LevelFilter.update, scoring.evaluate

    def updated(training, progress):
        calls.append(("levels", training.counters.iteration))
        return update(training, progress)

    def scored(*args):
        calls.append("scores")
        return score(*args)

    monkeypatch.setattr(LevelFilter, "update", staticmethod(updated))
    monkeypatch.setattr(scoring, "evaluate", scored)
    monkeypatch.chdir(tmp_path)
    write_tiny_config(trainer={"max_steps": 4}, evaluation={"every_n_steps": 2})
    fit()
    assert calls == [("levels", 2), "scores", ("levels", 4), "scores"]
    assert [row["iteration"] for row in metrics()] == ["2", "4"]
