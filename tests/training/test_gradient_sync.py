"""Several processes do what one does with a larger batch."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
import torch.distributed as dist
from helpers.ddp_run import STEPS, Join, fit
from helpers.listening import listening
from helpers.tiny_fit import write_tiny_config

from benchmarks.saved_often import saved_every
from neurad.training.gradient_sync import GradientSync

HERE = Path(__file__).resolve().parents[1]
ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}


@pytest.mark.parametrize(
    "kind", [*(pytest.param(kind, marks=pytest.mark.slow) for kind in ("hash", "dense")), "glossy"]
)
def test_two_processes_learn_what_one_learns_from_both_batches(tmp_path, kind):
    command = [sys.executable, str(HERE / "helpers" / "ddp_run.py"), str(tmp_path), kind]
    done = subprocess.run(command, env=ENVIRONMENT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("in a group at exit: False") == 2, done.stdout
    first, second = (torch.load(tmp_path / f"{rank}.pt", weights_only=True) for rank in range(2))
    assert first["iteration"] == STEPS
    assert first["samples"] == 2 * STEPS * 128 * 2
    for name, value in first["state"].items():
        assert torch.equal(value, second["state"][name]), f"{name} differs between the processes"

    joined, trainer = fit(1, kind=kind, joined=True)
    (start,) = (callback.start for callback in trainer.callbacks if isinstance(callback, Join))
    alone, _ = fit(1, kind=kind) if kind != "dense" else (None, None)
    for name, value in joined.state_dict().items():
        if name.startswith("world.guide.") and name != "world.guide.cdf":
            assert value.sum() > 0
            torch.testing.assert_close(first["state"][name], value, rtol=0.02, atol=0.02 * float(value.max()))
        if name.startswith(("materials", "radiance")) and name in start:
            moved = (value - start[name]).norm()
            # Sums in another order are all that may differ; Adam turns the rounding of tiny gradients into whole steps.
            assert (first["state"][name] - value).norm() <= 0.02 * moved, name
            if alone is not None and name.endswith("table"):
                assert (alone.state_dict()[name] - value).norm() > 0.2 * moved, name  # half the batch does differ


@contextlib.contextmanager
def fitting(folder, settings):
    """A fit in processes of its own, which end with the block; what they say is in ``log``."""
    words = ["fit", *(f"--{key}={value}" for key, value in settings.items()), *saved_every(0.2)]
    command = [sys.executable, "-m", "neurad", *words]
    with (folder / "log").open("w") as log:
        process = subprocess.Popen(command, env=ENVIRONMENT, cwd=folder, stdout=log, stderr=log, start_new_session=True)
    try:
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):  # nobody is left
            os.killpg(process.pid, signal.SIGKILL)


@pytest.mark.parametrize("interrupted", [pytest.param("the first", marks=pytest.mark.slow), "the second"])
def test_ctrl_c_stops_two_processes_after_the_same_iteration(tmp_path, interrupted):
    """One of them gets the signal; the other must not wait for it for ever, and the first writes a whole checkpoint."""
    write_tiny_config(tmp_path / "tiny.yaml", trainer={"devices": 2, "max_steps": 1_000_000})
    settings = {"config": "tiny.yaml", "evaluation.every_n_steps": "null", "evaluation.fraction": "0"}
    last = tmp_path / "lightning_logs" / "version_0" / "checkpoints" / "last.ckpt"
    with fitting(tmp_path, settings) as process:
        wait_until(lambda: last.exists() or process.poll() is not None, 120)
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
        (second,) = (int(pid) for pid in children if b"fit" in Path(f"/proc/{pid}/cmdline").read_bytes())
        before = last.stat().st_mtime_ns
        os.kill(process.pid if interrupted == "the first" else second, signal.SIGINT)
        code = process.wait(60)
        wait_until(lambda: not Path(f"/proc/{second}").exists(), 30)
    said = (tmp_path / "log").read_text()
    assert code == 130, said
    assert said.count("continues from") == 1
    assert last.stat().st_mtime_ns > before
    assert torch.load(last, weights_only=True)["neurad"]["iteration"] > 0


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="reads Linux's list of sockets")
def test_two_processes_listen_on_loopback_alone(tmp_path):
    settings = {
        "config": "cornell.yaml", "trainer.accelerator": "cpu", "trainer.devices": "2",
        "trainer.max_time": "null", "trainer.max_steps": "40", "data.patches": "16", "evaluation.fraction": "0",
        "model.objective.prior": "0", "model.objective.lhs": "0",  # nothing trains the field, and nobody waits for it
    }  # fmt: skip
    seen = set()
    with fitting(tmp_path, settings) as process:
        wait_until(lambda: seen.update(of_both(process.pid)) or process.poll() is not None, 120)
    assert process.returncode == 0, (tmp_path / "log").read_text()
    assert seen == {"0100007F"}  # 127.0.0.1


def of_both(pid):
    """Addresses on which a process and its children listen."""
    with contextlib.suppress(OSError):
        return listening(pid, *Path(f"/proc/{pid}/task/{pid}/children").read_text().split())
    return ()


def wait_until(true, seconds):
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "waited too long"
        time.sleep(0.1)


class Grid(torch.nn.Module):
    def __init__(self, sparse):
        super().__init__()
        self.grid = torch.nn.Module()
        self.grid.table = torch.nn.Parameter(torch.zeros(10, 2))
        dense = torch.zeros(10, 2)
        dense[[1, 4]] = torch.tensor([[1.0, 2.0], [3.0, 4.0]])
        self.grid.table.grad = dense.to_sparse(1) if sparse else dense.clone()
        self.expected = dense


@pytest.fixture
def alone(tmp_path):
    """A group of one process."""
    dist.init_process_group("gloo", init_method=f"file://{tmp_path}/meet", rank=0, world_size=1)
    yield
    dist.destroy_process_group()


@pytest.mark.parametrize("sparse", [True, False])
def test_one_process_averages_to_its_own_gradient(alone, sparse):
    made = Grid(sparse)
    recorded = (torch.tensor([3, 3, 1]), torch.rand(3, 2)), (torch.tensor([7, 0]), torch.rand(2, 2))
    factor, returned = GradientSync(made, {"grid.table"}).average(0.25, recorded)
    assert torch.equal(made.grid.table.grad.to_dense(), made.expected)
    assert factor == 0.25
    for mine, theirs in zip(recorded, returned, strict=True):
        assert torch.equal(theirs[0], mine[0])
        assert torch.equal(theirs[1], mine[1])


def test_what_nobody_records_is_not_sent(alone):
    scores = torch.tensor([7, 0]), torch.rand(2, 2)
    _, (guide, returned) = GradientSync(Grid(True), {"grid.table"}).average(0.25, (None, scores))
    assert guide is None
    assert torch.equal(returned[1], scores[1])
