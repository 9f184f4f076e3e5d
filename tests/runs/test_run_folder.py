"""Runs of the command line: what they write, when they evaluate, and how they continue."""

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from helpers.tiny_fit import checkpoint, config, fails, fit, metrics, run_folder

from neurad.callbacks import evaluation
from neurad.checkpoints.find import named_checkpoint
from neurad.cli import main
from neurad.core.errors import InputError
from neurad.training.inverse import InverseRenderer


@pytest.fixture
def at_iteration(monkeypatch):
    """Does something at the start of the step that follows so many iterations."""

    def install(iteration, action):
        step = InverseRenderer.training_step

        def training_step(self, batch, index):
            if self.iteration == iteration:
                action()
            return step(self, batch, index)

        monkeypatch.setattr(InverseRenderer, "training_step", training_step)

    return install


@pytest.fixture(autouse=True)
def heeds_interrupts():
    """A shell that starts the tests in the background has Ctrl-C ignored, which a run would respect."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_a_run_that_was_started_with_ctrl_c_ignored_is_not_stopped_by_it(tiny, at_iteration):
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    at_iteration(3, interrupt)
    fit("--trainer.max_steps=6", "--evaluation.every_n_steps=null")
    assert checkpoint()["neurad"]["iteration"] == 6
    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN


def interrupt():
    os.kill(os.getpid(), signal.SIGINT)


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="the system has no terminals that hang up")
def test_a_terminal_that_goes_leaves_a_checkpoint(tiny):
    import pty

    code = "import fcntl, termios\nfcntl.ioctl(0, termios.TIOCSCTTY, 0)\n"
    code += "from neurad.callbacks import checkpoint\ncheckpoint.EVERY_SECONDS = 1000.0\n"
    code += "from neurad.cli import main\nmain()"
    words = ["fit", "--config=tiny.yaml", "--trainer.max_steps=1000000", "--trainer.enable_progress_bar=true"]
    words += ["--evaluation.every_n_steps=3"]
    ours, theirs = pty.openpty()
    fitting = subprocess.Popen(
        [sys.executable, "-c", code, *words], stdin=theirs, stdout=theirs, stderr=theirs, start_new_session=True
    )
    os.close(theirs)
    os.set_blocking(ours, False)
    table, end = run_folder() / "metrics.csv", time.monotonic() + 120
    while not table.is_file() and fitting.poll() is None and time.monotonic() < end:
        with contextlib.suppress(BlockingIOError):
            os.read(ours, 1 << 16)
        time.sleep(0.05)
    os.close(ours)
    assert fitting.wait(60) == 128 + signal.SIGTERM
    assert checkpoint()["neurad"]["iteration"] >= 3


def test_run_folder_and_closing_table(tiny, capsys):
    fit("--trainer.max_steps=8", "--evaluation.every_n_steps=3")
    names = {p.name.split(".")[0] for p in run_folder().iterdir()}
    assert names == {"config", "metrics", "checkpoints", "views", "report", "cornell-radiometric"}
    assert list(run_folder().glob("cornell-radiometric/events.out.*"))
    rows = metrics()
    assert [row["iteration"] for row in rows] == ["3", "6", "8"]
    assert [int(row["samples"]) for row in rows] == [n * 16 * 4 for n in (3, 6, 8)]  # spp 4
    assert 0 < int(rows[0]["rays"]) < int(rows[1]["rays"]) < int(rows[2]["rays"])
    out = capsys.readouterr().out
    assert "best constant" in out
    assert f"run folder {run_folder()}" in out
    state = checkpoint()
    assert state["neurad"]["iteration"] == 8
    assert len(state["optimizer_states"]) == 2


@pytest.mark.parametrize(("least", "expected"), [(1, (4, 8, 12, 16)), (6, (6, 12, 16))])
def test_steps_alone_make_a_fixed_schedule(tiny, monkeypatch, least, expected):
    """As many evaluations as a run has marks, but of few steps no more than leave the fit most of the time."""
    monkeypatch.setattr(evaluation, "MARKS", 4)
    monkeypatch.setattr(evaluation, "MIN_STEPS", least)
    fit("--trainer.max_steps=16", "--evaluation.every_n_steps=null")
    assert [int(row["iteration"]) for row in metrics()] == list(expected)


def test_max_time_ends_the_run_and_evaluations_keep_to_their_fraction(tiny):
    fit("--trainer.max_time=00:00:00:01", "--evaluation.every_n_steps=null", "--evaluation.fraction=0")
    assert len(metrics()) == 1  # the one at the end, which is always made
    assert 0 < checkpoint()["neurad"]["iteration"] == int(metrics()[0]["iteration"])


def test_continuing_gives_what_one_run_gives(tiny, at_iteration):
    steps = ["--trainer.max_steps=12", "--evaluation.every_n_steps=4"]
    fit(*steps)
    at_iteration(5, interrupt)
    with pytest.raises(SystemExit) as stop:
        fit(*steps)
    assert stop.value.code == 130
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert checkpoint(1)["neurad"]["iteration"] == 6
    assert [row["iteration"] for row in metrics(1)] == ["4"]
    main(["fit", "--ckpt_path", "last"])
    assert metrics(1) == metrics(0)
    assert not run_folder(2).exists()


def test_the_command_line_beats_the_run_it_continues_wherever_that_is(tiny, monkeypatch):
    place = "--trainer.default_root_dir=elsewhere"
    fit("--trainer.max_steps=2", "--model.objective.epsilon=0.5", place)
    assert not Path("lightning_logs").exists()
    main(["fit", place, "--ckpt_path=last", "--trainer.max_steps=4"])
    monkeypatch.chdir("elsewhere")
    assert config()["model"]["objective"]["epsilon"] == 0.5
    main(["fit", "--ckpt_path=last", "--trainer.max_steps=6", "--model.objective.epsilon=0.25"])
    assert config()["model"]["objective"]["epsilon"] == 0.25
    assert metrics()[-1]["iteration"] == "6"
    assert config()["data"]["patches"] == 16  # of the run's own config, which no argument named


@pytest.mark.parametrize("after_the_step", [False, True])
def test_no_checkpoint_from_the_middle_of_an_iteration(tiny, at_iteration, monkeypatch, after_the_step):
    """Nor one from the middle of a stage: a fit that goes on from a roughness refinement half done has none at all."""

    def fail():
        raise RuntimeError("a bug in the middle of an iteration")

    if after_the_step:
        stage = lambda training, progress: training.counters.iteration == 4 and fail()  # noqa: E731
        monkeypatch.setattr("neurad.training.step.AFTER_STEP", (stage,))
    else:
        at_iteration(3, fail)
    monkeypatch.setattr("neurad.callbacks.checkpoint.EVERY_SECONDS", 0.0)
    with pytest.raises(RuntimeError, match="a bug"):
        fit("--trainer.max_steps=5")
    assert checkpoint()["neurad"]["iteration"] == 3
    assert not list(run_folder().rglob("*.part"))


def test_validate_test_and_predict(fitted_box, capsys):
    before = (run_folder() / "config.yaml").read_text()
    capsys.readouterr()
    main(["validate", "--trainer.enable_progress_bar=false"])
    assert "best constant" in capsys.readouterr().out
    assert not (run_folder() / "images").exists()
    main(["test", "--ckpt_path", "last", "--trainer.enable_progress_bar=false"])
    assert '"iteration": 2' in (run_folder() / "metrics.json").read_text()
    assert (run_folder() / "images" / "000_albedo.exr").is_file()
    (run_folder() / "images" / "000_albedo.exr").unlink()
    main(["predict", "--trainer.enable_progress_bar=false"])
    assert (run_folder() / "images" / "000_albedo.exr").is_file()
    assert (run_folder() / "config.yaml").read_text() == before
    assert not run_folder(1).exists()


def test_seeds_repeat_a_run_and_tell_runs_apart(tiny):
    for seed in (1, 1, 2):
        fit("--trainer.max_steps=3", f"--seed_everything={seed}")
    first, again, other = (checkpoint(version)["state_dict"] for version in range(3))
    assert all(torch.equal(first[key], again[key]) for key in first)
    assert any(not torch.equal(first[key], other[key]) for key in first)


def test_a_run_is_named_by_folder_or_number(tiny, capfd):
    fit("--trainer.max_steps=4")
    out = capfd.readouterr().out
    # Someone who has read nothing goes on from the last lines.
    assert "20 dB is a typical error of 0.1" in out
    commands = re.findall(r"^  neurad (.*?)  ", out, re.M)
    assert commands[0] == "test --ckpt_path version_0"
    assert "fit --ckpt_path version_0 --trainer.max_steps 8" in commands
    assert "export --ckpt_path version_0 --out room" in commands
    main(commands[1].split())
    assert checkpoint()["neurad"]["iteration"] == 8
    last = run_folder() / "checkpoints" / "last.ckpt"
    for name in ("version_0", str(run_folder()), str(run_folder().resolve()), "lightning_logs", ".", str(last)):
        assert named_checkpoint(Path(name), Path(), "run").resolve() == last.resolve()
    assert "there are version_0" in fails(capfd, "test", "--ckpt_path", "version_7")
    assert "did you mean" in fails(capfd, "test", "--ckpt_path", "lightning_log")
    with pytest.raises(InputError, match="run x: there is no such run folder"):
        named_checkpoint(Path("nothing/x"), Path(), "run x")


def test_only_training_counts_rays(tiny):
    """However often a run is evaluated, stopped, continued and tested."""
    fit("--data.patches=64", "--trainer.max_steps=6", "--evaluation.every_n_steps=100")
    fit("--data.patches=64", "--trainer.max_steps=6", "--evaluation.every_n_steps=2")
    (once,), often = ([int(row["rays"]) for row in metrics(version)] for version in (0, 1))
    assert once == often[2]
    assert often[0] < often[1] < often[2]
    per_step = (often[2] - often[1]) / 2
    assert often[0] > 2 * per_step, "the camera rays of the set-up count"
    main(["fit", "--ckpt_path=version_0", "--trainer.max_steps=8"])
    rays = checkpoint()["neurad"]["rays"]
    assert abs(rays - once - 2 * per_step) < 0.05 * per_step, "a continued run counts its steps alone"
    main(["test", "--ckpt_path=version_0"])
    assert json.loads((run_folder() / "metrics.json").read_text())["rays"] == rays
