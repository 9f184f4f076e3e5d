"""A run killed at any moment and continued gives what a run gives that nobody stopped, to the last bit."""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
import yaml
from helpers.tiny_fit import metrics
from helpers.tiny_scene import as_png, write_scene
from helpers.torch_threads import torch_threads

from neurad.callbacks import checkpoint
from neurad.callbacks.checkpoint import LastCheckpoint
from neurad.cli import main

pytest.importorskip("mitsuba")

STEPS, EVERY = 80, 20
GRID = {"levels": 4, "coarsest": 4, "finest": 32, "log2_size": 12}
CONFIG = {
    "seed_everything": 7,
    "trainer": {"max_steps": STEPS, "accelerator": "cpu", "enable_progress_bar": False},
    "data": {"root": "room", "patches": 64, "validation_pixels": 0.5, "exposure": "fit", "response": "fit"},
    "model": {
        "albedo": {"grid": GRID, "width": 16},
        "roughness": {"grid": GRID, "width": 16, "begin": "best", "structure": "auto"},
        "sampling": {"focus": 0.25},
        "lighting": {"emitters": "fit"},
        "radiance": {"grid": GRID, "width": 16, "hidden_layers": 2},
        "optimization": {"average": 0.3, "roughness_decay": 1.0},
    },
    "evaluation": {"every_n_steps": EVERY, "spp": 1},
}
OFTEN = "from neurad.callbacks import checkpoint; checkpoint.EVERY_SECONDS = 0.2"
COMMAND = [sys.executable, "-c", f"{OFTEN}; from neurad.cli import main; main()"]
ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1"}


def last(version):
    return Path(f"lightning_logs/version_{version}/checkpoints/last.ckpt")


def same(a, b, where="checkpoint"):
    """Checkpoints must agree to the last bit, but for what measures time and names the callbacks' own states."""
    assert type(a) is type(b), where
    if isinstance(a, dict):
        assert a.keys() == b.keys(), where
        for key in a:
            same(a[key], b[key], f"{where}.{key}")
    elif isinstance(a, list | tuple):
        assert len(a) == len(b), where
        for index, pair in enumerate(zip(a, b, strict=True)):
            same(*pair, f"{where}.{index}")
    elif isinstance(a, torch.Tensor):
        assert torch.equal(a, b), where
    else:
        assert a == b, where


@pytest.fixture
def one_thread():
    """As the process that is killed has."""
    with torch_threads(1):
        yield


def test_a_killed_run_continues_to_the_same_bits(tmp_path, monkeypatch, one_thread):
    monkeypatch.chdir(tmp_path)
    as_png(write_scene(tmp_path / "room"))
    Path("config.yaml").write_text(yaml.safe_dump(CONFIG))
    words = ["fit", "--config", "config.yaml"]
    main(words)

    process = subprocess.Popen([*COMMAND, *words], env=ENVIRONMENT, stdout=subprocess.DEVNULL)
    end = time.monotonic() + 120
    scores = last(1).parents[1] / "metrics.csv"  # written at iteration 20, so there is something to cut or continue
    while not (last(1).is_file() and scores.is_file()) and process.poll() is None and time.monotonic() < end:
        time.sleep(0.01)
    time.sleep(random.Random(20231).uniform(0.2, 0.6))
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert process.returncode == -signal.SIGKILL, "the run ended before it was killed: give it more steps"
    assert 0 < torch.load(last(1), weights_only=True)["neurad"]["iteration"] < STEPS
    assert len(metrics(1)) < len(metrics(0))

    main(["fit", "--ckpt_path", "last"])
    assert metrics(1) == metrics(0)
    assert [int(row["iteration"]) for row in metrics(1)] == [*range(EVERY, STEPS + 1, EVERY)]
    whole, continued = (torch.load(last(version), weights_only=True) for version in (0, 1))
    for state in (whole, continued):
        assert state["neurad"].pop("seconds") > 0
        assert state["neurad"].pop("processor_seconds") > 0
        state["neurad"].pop("waited_seconds")
    for part in ("neurad", "state_dict", "optimizer_states", "global_step"):
        same(whole[part], continued[part], part)
    assert continued["neurad"]["iteration"] == continued["global_step"] == STEPS
    assert "world.lights.reflected" in continued["state_dict"]
    assert len(continued["optimizer_states"]) == 6
    assert continued["state_dict"]["development.values"].abs().max() > 0
    assert continued["state_dict"]["development.bend"].abs().max() > 0
    assert continued["state_dict"]["materials.fields.roughness.hierarchy.made"] == 1
    assert Path("lightning_logs/version_1/exposures.csv").read_text().startswith("view,known,r,g,b,iteration")
    assert not Path("lightning_logs/version_2").exists()


def test_a_run_killed_after_its_last_checkpoint_is_brought_to_its_end(tiny, monkeypatch, capsys):
    """The last checkpoint in between is of the last iteration, but not of its evaluation, which fits factors."""
    words = ["--trainer.max_steps=30", "--data.validation_pixels=0.03", "--data.patches=64"]
    words += ["--evaluation.every_n_steps=10"]
    monkeypatch.setattr(checkpoint, "EVERY_SECONDS", 0.0)
    main(["fit", "--config=tiny.yaml", *words])
    with monkeypatch.context() as patch:
        patch.setattr(LastCheckpoint, "on_train_end", lambda *_: None)
        main(["fit", "--config=tiny.yaml", *words])
    whole, cut = (torch.load(last(version), weights_only=True)["state_dict"] for version in (0, 1))
    assert any(not torch.equal(whole[name], cut[name]) for name in whole), "there is nothing to make up for"
    main(["fit", "--ckpt_path=version_1"])
    same(whole, torch.load(last(1), weights_only=True)["state_dict"])
    assert metrics(1) == metrics(0)
    capsys.readouterr()
    main(["fit", "--ckpt_path=version_1"])
    assert metrics(1) == metrics(0), "and a finished run stays as it is"
