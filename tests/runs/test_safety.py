"""Nothing is lost: damaged checkpoints, refused writes, two runs in one folder."""

import errno
import os
import random
import shutil
from pathlib import Path

import pytest
import torch
from helpers.small_files import small_files
from helpers.tiny_fit import checkpoint, fails, fit, metrics, run_folder, tree

import neurad
from neurad.callbacks.run_folder import RunLogger
from neurad.checkpoints.file import check_seal, read_checkpoint, write_checkpoint
from neurad.cli import main
from neurad.core.errors import InputError
from neurad.runtime import files
from neurad.runtime.folders import LOCK, FolderLock
from neurad.training.inverse import InverseRenderer

STEPS = ("--trainer.max_steps=4", "--evaluation.every_n_steps=2")


@pytest.fixture(autouse=True)
def _a_checkpoint_after_each_step(monkeypatch):
    monkeypatch.setattr("neurad.callbacks.checkpoint.EVERY_SECONDS", 0.0)


def flip(path, bit):
    data = bytearray(path.read_bytes())
    data[bit // 8] ^= 1 << bit % 8
    path.write_bytes(data)


def test_every_flipped_bit_is_found(tmp_path):
    path = tmp_path / "last.ckpt"
    write_checkpoint({"weights": torch.arange(300.0)}, path)
    assert torch.equal(torch.load(path, weights_only=True)["weights"], torch.arange(300.0))
    check_seal(path, "it")
    whole, chosen = path.read_bytes(), random.Random(5)
    for bit in [0, 8 * len(whole) - 1, *chosen.sample(range(8 * len(whole)), 60)]:
        path.write_bytes(whole)
        flip(path, bit)
        with pytest.raises(InputError, match=r"it is damaged|it is not a readable checkpoint"):
            check_seal(path, "it")
    for length in [0, 1, 63, len(whole) - 1, *chosen.sample(range(len(whole)), 20)]:
        path.write_bytes(whole[:length])
        with pytest.raises(InputError):
            check_seal(path, "it")


def test_last_falls_back_to_the_checkpoint_before(tiny, capfd):
    fit(*STEPS)
    last, previous = (run_folder() / "checkpoints" / name for name in ("last.ckpt", "previous.ckpt"))
    assert read_checkpoint(previous, "")["neurad"]["iteration"] < checkpoint()["neurad"]["iteration"] == 4
    scores = metrics()
    flip(last, 8 * (last.stat().st_size // 2) + 3)
    capfd.readouterr()
    main(["fit", "--ckpt_path", "last"])
    printed = capfd.readouterr()
    assert "last.ckpt: it is damaged" in printed.err
    assert "previous.ckpt takes its place" in printed.err
    assert metrics() == scores  # the steps between were made again, and are the same
    assert read_checkpoint(last, "")["neurad"]["iteration"] == 4
    assert read_checkpoint(previous, "")["neurad"]["iteration"] < 4  # the good one, not the damaged one

    # A newer run without a whole checkpoint: the older one is named, not taken.
    shutil.copytree(run_folder(0), run_folder(1))
    for name in ("last.ckpt", "previous.ckpt"):
        (run_folder(1) / "checkpoints" / name).write_bytes(b"no checkpoint")
    error = fails(capfd, "fit", "--ckpt_path", "last")
    assert "version_1: it has no whole checkpoint" in error
    assert "version_0/checkpoints/last.ckpt" in error

    # And a folder that another process writes into.
    shutil.rmtree(run_folder(1))
    lock = FolderLock(run_folder(0))
    try:
        error = fails(capfd, "fit", "--ckpt_path", "last", "--trainer.max_steps=6")
        assert f"a training run is writing into it (process {os.getpid()}" in error
        assert metrics() == scores
        main(["test"])  # reading is no harm
    finally:
        lock.release()
    assert not (run_folder(0) / LOCK).exists()


def test_two_runs_that_start_at_once_get_folders_of_their_own(tmp_path):
    loggers = [RunLogger(tmp_path) for _ in range(3)]
    assert {logger.version for logger in loggers} == {"version_0"}  # each would take the same
    for logger in loggers:
        logger.open()
    assert [logger.version for logger in loggers] == [f"version_{n}" for n in range(3)]
    assert sorted(path.name for path in (tmp_path / "lightning_logs").iterdir()) == [f"version_{n}" for n in range(3)]


@pytest.mark.parametrize("after", [0, 2000])
def test_a_disk_that_fills_up_leaves_the_last_checkpoint(tiny, capfd, monkeypatch, after):
    fit(*STEPS)
    folder = run_folder() / "checkpoints"
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    write_all = files.write_all
    left = after

    def fills_up(handle, data):
        nonlocal left
        left -= len(data)
        if left < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        write_all(handle, data)

    monkeypatch.setattr("neurad.checkpoints.file.write_all", fills_up)
    error = fails(capfd, "fit", "--ckpt_path", "last", "--trainer.max_steps=6", "--evaluation.every_n_steps=1000")
    assert "last.ckpt: no space is left on its disk" in error
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_checkpoints_are_staged_beside_their_place(tiny, monkeypatch):
    monkeypatch.setenv("TMPDIR", "/nowhere")
    monkeypatch.setattr("tempfile.tempdir", "/nowhere")
    (run_folder() / "checkpoints").mkdir(parents=True)
    left = run_folder() / "checkpoints" / f"last.ckpt{files.PART}"
    fit(*STEPS)
    assert checkpoint(1)["neurad"]["iteration"] == 4
    left.write_bytes(b"what a killed run was writing")
    shutil.copytree(run_folder(1), run_folder(0), dirs_exist_ok=True)
    shutil.rmtree(run_folder(1))
    main(["fit", "--ckpt_path", "last", "--trainer.max_steps=5"])
    assert not left.exists()


def test_a_run_does_not_go_on_with_other_photographs(tiny, capfd, monkeypatch):
    fit(*STEPS)
    before = checkpoint()
    monkeypatch.setattr("datamodules.image_cache.checksum", lambda pixels: 5)
    error = fails(capfd, "fit", "--ckpt_path", "last", "--trainer.max_steps=6")
    assert "the training photographs are not those that the run began with" in error
    assert checkpoint()["neurad"] == before["neurad"]


# ---- what neurad refuses before it works: folders that cannot be written, tables and checkpoints that are none


LAST, PREVIOUS = (Path("checkpoints") / f"{name}.ckpt" for name in ("last", "previous"))


def test_what_cannot_be_written_is_found_before_the_set_up(tiny, capfd, monkeypatch):
    def set_up(self):
        raise AssertionError("the set-up has begun")

    monkeypatch.setattr(InverseRenderer, "on_fit_start", set_up)
    with small_files(20000):
        error = fails(capfd, "fit", "--config=tiny.yaml", "--trainer.max_steps=2")
    assert "its checkpoints need files of" in error
    Path("lightning_logs").touch()
    error = fails(capfd, "fit", "--config=tiny.yaml", "--trainer.max_steps=2")
    assert "lightning_logs: it is a file, but a folder is needed" in error
    error = fails(capfd, "render", "--scene=cornell", "--out=lightning_logs/x")
    assert "--out lightning_logs/x: a part of its path is a file" in error
    assert "a part of its path is a file" in fails(capfd, "stress", "--quick", "--out=lightning_logs/x")
    compare = ("compare", "--config=tiny.yaml", "--methods=ours", "--budget=1")
    assert "it is a file" in fails(capfd, *compare, "--out=tiny.yaml")
    assert "no space is left" in fails(capfd, "bench", "step", "--out=/dev/full")
    assert not Path("/dev/full").is_file()


def test_metrics_that_are_no_table(fitted_box, capfd):
    table = run_folder() / "metrics.csv"
    good = table.read_bytes()
    for bad, why in (
        (good + b"\x00\xff\xfe,1,2\n", "line 3 is not the text of a table"),
        (good.replace(b"\n2,", b"\nx,"), "could not convert string to float"),
        (b"a,b\n1,2\n", "it has no columns iteration and seconds"),
    ):
        table.write_bytes(bad)
        before = tree(run_folder())
        assert f"{table}: {why}" in fails(capfd, "fit", "--ckpt_path=last", "--trainer.max_steps=4")
        assert tree(run_folder()) == before


def progress(state):
    """The number of steps that Lightning's loop keeps."""
    return state["loops"]["fit_loop"]["epoch_progress"]["current"]


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda state: state.pop("pytorch-lightning_version"), "pytorch-lightning_version is missing"),
        (lambda state: state["neurad"].update(iteration=-3), "neurad.iteration is -3"),
        (lambda state: state["neurad"].update(seconds=float("nan")), "neurad.seconds is nan"),
        (lambda state: state["loops"].update(fit_loop=[1]), "its loops are not those of a fit"),
        (lambda state: progress(state).update(ready=b"x"), "its loops are not those of a fit"),
        (lambda state: state["optimizer_states"].pop(), "the state of 1 optimizers, but these settings need 2"),
        (lambda state: state["optimizer_states"][0].clear(), "does not hold what a run of these settings writes"),
        (lambda state: state["callbacks"].update(Evaluate=3), "does not hold what a run of these settings writes"),
        (lambda state: state.update(state_dict={"a": 1}), "state_dict"),
        (lambda state: state.pop("neurad"), "neurad is missing"),
    ],
)
def test_checkpoints_with_strange_entries(fitted_box, capfd, change, why):
    state = checkpoint()
    change(state)
    write_checkpoint(state, Path("strange.ckpt"))
    assert why in fails(capfd, "fit", "--config=tiny.yaml", "--ckpt_path=strange.ckpt", "--trainer.max_steps=4")


def test_an_older_or_a_previous_checkpoint_is_named_and_not_taken(tiny, capfd):
    fit("--trainer.max_steps=2")
    run_folder(1).mkdir()
    error = fails(capfd, "fit", "--ckpt_path=last")
    assert f"run {run_folder(1)}: it has no checkpoint {LAST}, it ended before its first" in error
    assert f"the newest run that has one continues from {run_folder(0) / LAST}" in error
    with pytest.raises(InputError, match="no checkpoint"):
        neurad.load()
    last = run_folder(0) / LAST
    last.write_bytes(last.read_bytes()[:-1])
    error = fails(capfd, "fit", f"--ckpt_path={last}")
    assert f"the one before it is whole: {run_folder(0) / PREVIOUS}" in error
