"""The benchmarks: their bookkeeping, and that each of them runs and writes its table."""

import argparse
import csv
import time

import pytest
import torch

from benchmarks.bench import growth, memory, stages, start
from benchmarks.bench.measure import floor
from benchmarks.bench.memory_watch import resident
from neurad.cli import main
from neurad.fields.hash_grid import HashGrid

CPU = torch.device("cpu")
SMALL = [
    "--config", "cornell.yaml", "--set", "data.patches=64", "--set", "model.sampling.spp=2",
    "--set", "model.sampling.cached_spp=2",
]  # fmt: skip


def table(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_time_counts_for_the_innermost_stage(monkeypatch):
    now = iter([0.0, 1.0, 3.0, 7.0, 7.5, 8.5])
    monkeypatch.setattr(time, "perf_counter", lambda: next(now))
    recorder = stages.Recorder(CPU)
    with recorder.stage("outer"):  # 0 to 8.5
        with recorder.stage("inner"):  # 1 to 3
            pass
        with recorder.stage("inner"):  # 7 to 7.5
            pass
    seconds, extra_bounce_seconds = recorder.take()
    assert seconds == {"outer": 1.0 + 4.0 + 1.0, "inner": 2.0 + 0.5}
    assert extra_bounce_seconds == 0.0
    assert recorder.take() == ({}, 0.0)


def test_floor_is_what_the_slowest_resource_needs():
    rates = {"closest": 1e6, "shadow": 0.0, "matrix": 1e9, "bandwidth": 1e8}
    assert floor("tracing: closest", stages.Work(lanes=1000), rates) == (1.0, "tracer")
    assert floor("tracing: shadow", stages.Work(lanes=1000), rates) == (None, "")
    assert floor(stages.LAYERS, stages.Work(bytes=1.0, operations=2e6), rates) == (2.0, "matrix")
    assert floor("bsdf", stages.Work(bytes=1e5), rates) == (1.0, "bandwidth")
    assert floor("bsdf", stages.Work(), rates) == (None, "")


def test_a_lookup_reads_no_entry_twice():
    grid = HashGrid(2, 4, 64, log2_size=10)  # 125 entries and 1024
    assert stages.table_bytes(grid, 10) == (80 + 80) * 8
    assert stages.table_bytes(grid, 100000) == (125 + 1024) * 8


@pytest.mark.main
def test_step_has_every_stage_and_puts_the_library_back(tmp_path, capsys):
    out = tmp_path / "step.csv"
    forward, backward = HashGrid.forward, stages.mlp._Layers.backward
    glossy = ["--config", "patterns.yaml", *SMALL[2:]]  # a Lambertian scene leaves stages out
    main(["bench", "step", *glossy, "--steps", "3", "--warmup", "2", "--out", str(out)])
    assert "ms a step" in capsys.readouterr().out
    rows = {row["stage"]: row for row in table(out)}
    whole = float(rows.pop("whole step, no stopwatch")["ms"])
    assert float(rows.pop("(of these: second hits)")["ms"]) > 0
    assert set(stages.STAGES) <= set(rows)
    for stage in stages.STAGES:
        assert float(rows[stage]["ms"]) > 0
        assert float(rows[stage]["floor_ms"]) > 0, stage
    # 64 pixels x 2 positions, a second hit for an eighth of them: every one casts a ray to what it sees next.
    assert 128 <= float(rows["tracing: closest"]["lanes"]) <= 256
    assert float(rows[stages.LAYERS]["lanes"]) >= 2 * 128
    assert sum(float(rows[stage]["percent"]) for stage in rows) == pytest.approx(100.0)
    assert whole > 0
    assert HashGrid.forward is forward
    assert stages.mlp._Layers.backward is backward


@pytest.mark.main
def test_encode_covers_both_implementations(tmp_path):
    out = tmp_path / "encode.csv"
    sizes = "--points 256 --levels 2 --finest 8 --log2_size 8 --size 8 --hidden_layers 1 --width 8 --seconds 0.001"
    main(["bench", "encode", *sizes.split(), "--out", str(out)])
    rows = table(out)
    assert {row["layer"] for row in rows} == {
        f"{name}, {kind}" for name in ("hash grid", "dense grid", "network") for kind in ("kernel", "reference")
    }
    assert all(float(row["ms"]) > 0 and float(row["floor_ms"]) > 0 for row in rows)


@pytest.mark.main
def test_trace_names_its_best_batch(tmp_path):
    out = tmp_path / "trace.csv"
    words = ["--scene", "cornell", "--tracers", "embree", "--sizes", "16,512", "--seconds", "0.001"]
    main(["bench", "trace", *words, "--out", str(out)])
    rows = table(out)
    assert [(row["rays"], row["batch"]) for row in rows[:3]] == [("camera", "16"), ("camera", "512"), ("bounce", "16")]
    for kind in ("camera", "bounce", "shadow"):
        assert min(float(row["ratio"]) for row in rows if row["rays"] == kind) == pytest.approx(1.0)


@pytest.mark.parametrize(("curve", "value", "column"), [("triangles", 500, "triangles"), ("views", 3, "views")])
def test_growth_measures_what_has_grown(curve, value, column):
    parser = argparse.ArgumentParser()
    growth.add_arguments(parser)
    options = parser.parse_args(["--side", "16", "--steps", "2", "--warmup", "1", *SMALL])
    row = growth.measure(options, curve, value)
    assert row[column] == pytest.approx(value, rel=0.1)
    assert row["pixels"] == 256
    assert row["ms_per_step"] > 0
    assert row["setup_s"] > 0


def test_memory_on_a_line():
    slope, scatter = memory.line_through([(x, 100.0 + 0.25 * x) for x in range(0, 4000, 100)])
    assert slope == pytest.approx(250.0)
    assert scatter == pytest.approx(0.0, abs=1e-6)
    assert resident() > 10_000


SETTINGS = ["--config=cornell.yaml", "--data.patches=64", "--model.sampling.spp=2", "--model.sampling.cached_spp=2"]


def test_parts_of_a_start_add_up():
    *parts, whole = start.start(SETTINGS, cold=False)
    assert len(parts) == len(start.PARTS)
    for key in ("seconds", "processor_s"):
        assert all(part[key] > 0 for part in parts)
        assert sum(part[key] for part in parts) == pytest.approx(whole[key])
