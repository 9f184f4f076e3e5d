"""What neurad refuses before it works: folders that cannot be written, tables and checkpoints that are none."""

import resource
from contextlib import contextmanager
from pathlib import Path

import pytest
from helpers.tiny_fit import checkpoint, fails, fit, run_folder

import neurad
from neurad.checkpoints.file import write_checkpoint
from neurad.core.errors import InputError
from neurad.training.inverse import InverseRenderer

LAST, PREVIOUS = (Path("checkpoints") / f"{name}.ckpt" for name in ("last", "previous"))


def files():
    """Times and sizes of all files of a run."""
    return {p: (p.stat().st_mtime_ns, p.stat().st_size) for p in run_folder().rglob("*") if p.is_file()}


@contextmanager
def file_size(limit):
    """As after ``ulimit -f``, in bytes."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.main
def test_what_cannot_be_written_is_found_before_the_set_up(tiny, capfd, monkeypatch):
    def set_up(self):
        raise AssertionError("the set-up has begun")

    monkeypatch.setattr(InverseRenderer, "on_fit_start", set_up)
    with file_size(20000):
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
    assert "no space is left" in fails(capfd, "bench", "trace", "--out=/dev/full")
    assert not Path("/dev/full").is_file()


@pytest.mark.main
def test_metrics_that_are_no_table(fitted_box, capfd):
    table = run_folder() / "metrics.csv"
    good = table.read_bytes()
    for bad, why in (
        (good + b"\x00\xff\xfe,1,2\n", "line 3 is not the text of a table"),
        (good.replace(b"\n2,", b"\nx,"), "could not convert string to float"),
        (b"a,b\n1,2\n", "it has no columns iteration and seconds"),
    ):
        table.write_bytes(bad)
        before = files()
        assert f"{table}: {why}" in fails(capfd, "fit", "--ckpt_path=last", "--trainer.max_steps=4")
        assert files() == before


def progress(state):
    """The number of steps that Lightning's loop keeps."""
    return state["loops"]["fit_loop"]["epoch_progress"]["current"]


@pytest.mark.main
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


@pytest.mark.main
def test_an_older_or_a_previous_checkpoint_is_named_and_not_taken(tiny, capfd):
    fit("--trainer.max_steps=2", "--checkpoint.every_seconds=0")
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
