"""The table of stiff and extreme cases: its rows, files and exit code, and a few cases that must be able to fail."""

import math

import pytest
from helpers.tables import csv_rows
from helpers.tiny_fit import write_tiny_config

from benchmarks.closed_form import reflected_radiance
from benchmarks.stress import numbers
from benchmarks.stress import run as stress
from benchmarks.stress.case import Case, Outcome, judge
from benchmarks.stress.fit import resized
from benchmarks.stress.folder import photograph, write_folder
from benchmarks.stress.run import collect
from benchmarks.stress.verb import FAMILIES
from neurad.cli import main
from neurad.formats.load import load_scene
from neurad.runs.child import Ended
from neurad.scene.builtin import build_furnace, build_sphere
from neurad.scene.geometry import Geometry


@pytest.fixture(autouse=True)
def _place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def case(error, bar, quick=True):
    return Case("stiff", f"an error of {error}", "none", lambda _: Outcome(error, bar, "seen"), quick)


def raising(_):
    raise ValueError("it broke")


def test_the_table_is_printed_and_written_and_a_failure_ends_with_1(monkeypatch, capsys, tmp_path):
    rows = [case(1.0, 1.0), case(2.0, 1.0), case(5.0, None), case(math.nan, None), case(math.inf, 1.0),
            Case("stiff", "x", "y", raising), case(9.0, 1.0, quick=False)]  # fmt: skip
    monkeypatch.setattr(stress, "collect", lambda only: rows)
    with pytest.raises(SystemExit) as stop:
        main(["stress", "--quick"])
    assert stop.value.code == 1
    assert "6 rows, 4 failed" in capsys.readouterr().out
    written = csv_rows(tmp_path / "stress.csv")
    assert [row["verdict"] for row in written] == ["ok", "FAIL", "stated", "FAIL", "FAIL", "FAIL"]
    assert written[-1]["note"] == "ValueError: it broke"
    with pytest.raises(SystemExit) as stop:  # nothing is written over
        main(["stress", "--quick"])
    assert stop.value.code == 2
    monkeypatch.setattr(stress, "collect", lambda only: rows[:1])
    main(["stress", "--overwrite"])


def test_every_family_has_cases_named_once_and_a_real_row_passes():
    cases = collect()
    assert list(stress.CASES) == list(dict.fromkeys(c.family for c in cases)) == list(FAMILIES)
    assert len({(c.family, c.extreme) for c in cases}) == len(cases)
    made = next(c for c in cases if c.extreme == "albedo 1, roughness 0 in the estimate")  # takes a second
    assert judge(made, True)["verdict"] == "ok"


def test_closed_forms():
    assert reflected_radiance(Geometry(build_furnace(0.9)), 0.9) == pytest.approx(9.0)
    fraction = (1.0 - math.cos(math.radians(20.0))) / 2.0  # of the sphere that emits 10
    assert reflected_radiance(Geometry(build_sphere(0.5)), 0.5) == pytest.approx(10.0 * fraction, rel=0.05)


def test_extreme_numbers_go_through_the_command_line(monkeypatch, capsys, tmp_path):
    """Two rows of the family, in this process and with tiny fields; what is not seen changes nothing."""
    pytest.importorskip("mitsuba")
    write_tiny_config(tmp_path / "tiny.yaml")
    commands = []

    def here(arguments, log):
        commands.append(arguments)
        main(arguments)
        return Ended(0, 0.0, None, None, "")

    monkeypatch.setattr(numbers, "run_neurad", here)
    size = numbers.Size(pixels=8, spp=1, steps=2, arguments=("--config", str(tmp_path / "tiny.yaml")))
    monkeypatch.setitem(stress.CASES, "numbers", lambda: numbers.cases(quick_size=size))
    main(["stress", "--only", "numbers", "--quick"])
    assert [arguments[0] for arguments in commands] == ["fit"] * 3  # the plain scene's is made once
    rows = csv_rows(tmp_path / "stress.csv")
    assert [row["verdict"] for row in rows] == ["ok", "ok"]
    assert [row["extreme"] for row in rows] == ["light times 1e-12", "three stray vertices at 1000"]
    assert all(abs(float(row["error"])) < 0.01 for row in rows)


def test_a_fit_that_fails_fails_its_row_with_its_sentence(monkeypatch):
    monkeypatch.setattr(numbers, "run_neurad", lambda arguments, log: Ended(2, 0.0, None, None, "no light"))
    row = judge(numbers.cases(quick_size=numbers.Size(pixels=4, spp=1))[0], True)
    assert row["verdict"] == "FAIL"
    assert row["note"] == "RuntimeError: no light"


def test_a_written_scene_is_the_scene(tmp_path):
    pytest.importorskip("mitsuba")
    scene = resized(numbers.glossy(0.25), 4)
    write_folder(scene, tmp_path / "room", photograph(scene, 1), 2.0)
    read = load_scene(str(tmp_path / "room"), None)
    for mine, other in zip(scene.meshes, read.meshes, strict=True):
        assert mine.vertices[mine.faces].tolist() == other.vertices[other.faces].tolist()
        assert (mine.radiance is None) == (other.radiance is None)
        here, there = scene.materials[mine.material], read.materials[other.material]
        assert here.model == there.model
        assert there.albedo.value.tolist() == pytest.approx(here.albedo.value.tolist(), rel=1e-6)
    assert read.materials[0].roughness.value.tolist() == [0.25]
    assert [view.camera.fov_x for view in read.test] == [view.camera.fov_x for view in scene.test]
