"""What may happen to a run: kills, full and read-only disks, a moved clock. Nothing is lost, and it goes on alike."""

import math
import os
import random
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import torch

from benchmarks.bench.options import SMALL_FIELDS
from benchmarks.stress.case import Case, Outcome
from benchmarks.stress.fit import resized
from benchmarks.stress.folder import photograph, write_folder
from neurad.checkpoints.file import read_checkpoint
from neurad.checkpoints.find import RUNS, run_checkpoint
from neurad.core.errors import InputError
from neurad.runs.child import NEURAD, last_message
from neurad.runtime.tables import read_csv
from neurad.scene.builtin import build_cornell

STEPS = 60
"""Steps of each run."""
KILLS, QUICK_KILLS = 100, 2
SETTINGS = (
    "--trainer.max_time=null", f"--trainer.max_steps={STEPS}", "--trainer.enable_progress_bar=false",
    "--trainer.accelerator=cpu", "--data.patches=16", "--model.sampling.spp=4",
    "--model.sampling.cached_spp=4", "--evaluation.every_n_steps=10", "--evaluation.spp=1", *SMALL_FIELDS,
)  # fmt: skip
_CLOCK = """import time
real, start = time.time, time.monotonic()
time.time = lambda: real() - 3e8 * ((time.monotonic() - start) % 0.4 < 0.2)
"""
"""A start-up file of Python after which the wall clock jumps back by ten years and forth again, five times a second."""


@dataclass
class Runs:
    """One scene folder, and the run of it that nobody disturbs, in a folder that goes with this object."""

    kills: int = KILLS
    seed: int = 20261123
    differences: list[str] = field(default_factory=list)
    """What was lost or came out differently, of the row that is measured."""

    @cached_property
    def folder(self) -> Path:
        """Where everything lies."""
        self._kept = tempfile.TemporaryDirectory(prefix="neurad_faults_")
        return Path(self._kept.name)

    @cached_property
    def scene(self) -> Path:
        """A scene folder with photographs of 16 x 16 pixels."""
        scene = resized(build_cornell(), 16)
        write_folder(scene, self.folder / "scene", photograph(scene, 8), 1.0)
        return self.folder / "scene"

    @cached_property
    def undisturbed(self) -> tuple[Any, Any]:
        """Scores and state of the run that nobody disturbs."""
        place = self.new("undisturbed")
        child = self.start(place, self.fresh())
        if child.wait() != 0:
            raise RuntimeError(message(place))
        return outcome(place)

    def new(self, name: str) -> Path:
        """A working folder of its own."""
        place = self.folder / name
        place.mkdir()
        return place

    def fresh(self, scene: Path | None = None) -> list[str]:
        """Arguments of a run from its beginning."""
        root = self.scene if scene is None else scene
        return ["fit", "--config", "cornell.yaml", "--data.scene=null", f"--data.root={root}", *SETTINGS]

    def start(
        self, place: Path, arguments: Sequence[str], command: Sequence[str] = NEURAD, **environment: str
    ) -> subprocess.Popen[bytes]:
        """Start ``neurad ARGUMENTS`` in ``place``, with a checkpoint after each step; what it prints goes to a file
        beside the run's folder.
        """
        from benchmarks.saved_often import saved_every

        with log_of(place).open("wb") as log:
            words, own = [*command, *arguments, *saved_every(0.0)], {**os.environ, **environment}
            return subprocess.Popen(words, cwd=place, env=own, stdout=log, stderr=subprocess.STDOUT)

    def next(self, place: Path) -> list[str]:
        """Arguments that begin the run in ``place`` or, once it has a checkpoint, continue it."""
        begun = any(place.glob(f"{RUNS}/version_*/checkpoints/*.ckpt"))
        return ["fit", "--ckpt_path", "last"] if begun else self.fresh()

    def go_on(self, place: Path, command: Sequence[str] = NEURAD, **environment: str) -> int:
        """Start or continue the run in ``place`` and wait for its end."""
        return self.start(place, self.next(place), command, **environment).wait()

    def expect(self, agrees: bool, what: str) -> None:
        """Note what was lost, unless it ``agrees``."""
        if not agrees:
            self.differences.append(what)

    def compare(self, place: Path) -> None:
        """Note whether the run in ``place`` came out like the undisturbed one."""
        for name, mine, other in zip(("scores", "state"), outcome(place), self.undisturbed, strict=True):
            self.expect(same(mine, other), f"{name} differ")


def outcome(place: Path) -> tuple[Any, Any]:
    """Scores without the columns of time, and the state of the last checkpoint without seconds of any kind."""
    (run,) = (place / RUNS).glob("version_*")
    columns, rows = read_csv(run / "metrics.csv")
    scores = [columns, *[{key: value for key, value in row.items() if not key.endswith("seconds")} for row in rows]]
    state = read_checkpoint(run / "checkpoints" / "last.ckpt", "it", stay_on_disk=False)
    own = {key: value for key, value in state["neurad"].items() if not key.endswith("seconds")}
    return scores, [own, *(state[key] for key in ("state_dict", "optimizer_states", "global_step"))]


def same(a: Any, b: Any) -> bool:
    """Whether two trees of plain values and tensors agree to the last bit."""
    if isinstance(a, torch.Tensor) and isinstance(b, torch.Tensor):
        return torch.equal(a, b)
    if isinstance(a, dict) and isinstance(b, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if isinstance(a, list | tuple) and isinstance(b, list | tuple):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    return bool(a == b) and type(a) is type(b)


def message(place: Path) -> str:
    """The sentence that the last child in ``place`` ended with."""
    return last_message(log_of(place).read_text(errors="replace"))


def log_of(place: Path) -> Path:
    """What the last child in ``place`` printed."""
    return place.with_name(f"{place.name}.log")


# ---- rows


def killed(runs: Runs) -> str:
    """Runs that are killed and continued until as many kills are through: at any time between start and end of a child,
    every fourth within its start-up, every tenth again as soon as it runs.
    """
    chosen = random.Random(runs.seed)
    kills = writing = starting = ended = 0
    place, life = runs.new("killed_0"), 8.0
    while kills < runs.kills:
        done = reached(place)
        child = runs.start(place, runs.next(place))
        begin = time.monotonic()
        early = kills % 4 == 0
        if not early:
            wait_for_step(child, place)
        time.sleep(chosen.uniform(0.0, life if early else 0.7) * (0.02 if kills % 10 == 9 else 1.0))
        child.send_signal(signal.SIGKILL)
        if child.wait() == 0:
            life = time.monotonic() - begin
            runs.compare(place)
            ended += 1
            place = runs.new(f"killed_{ended}")
            continue
        runs.expect(child.returncode == -signal.SIGKILL, f"ended by itself: {message(place)}")
        kills += 1
        starting += early
        writing += any(place.glob(f"{RUNS}/version_*/checkpoints/*.part"))
        runs.expect(reached(place) >= done, f"iteration {done} was lost")
        if runs.differences:
            break
    runs.expect(runs.go_on(place) == 0, f"it did not continue: {message(place)}")
    runs.compare(place)
    return f"{kills} kills in {ended + 1} runs, {starting} in start-up, {writing} while a checkpoint was written"


def wait_for_step(child: subprocess.Popen[bytes], place: Path) -> None:
    """Wait until a child has written a checkpoint."""
    begin = time.time()
    while child.poll() is None:
        for path in place.glob(f"{RUNS}/version_*/checkpoints/last.ckpt"):
            if path.stat().st_mtime > begin:
                return
        time.sleep(0.002)


def reached(place: Path) -> int:
    """Iteration of the run's last whole checkpoint; 0 before its first.

    Raises:
        InputError: there are checkpoints, but none is whole.
    """
    found = sorted((place / RUNS).glob("version_*"))
    if not found or not any((found[-1] / "checkpoints").glob("*.ckpt")):
        return 0
    return int(read_checkpoint(run_checkpoint(found[-1], "it"), "it")["neurad"]["iteration"])


def beside_another(runs: Runs) -> str:
    """Two runs in one working folder at once, one of them killed; then two that would continue the same."""
    place = runs.new("two")
    children = [runs.start(place, runs.fresh()) for _ in range(2)]
    while len([*place.glob(f"{RUNS}/*/checkpoints/last.ckpt")]) < 2 and all(child.poll() is None for child in children):
        time.sleep(0.002)
    children[0].kill()
    codes = [child.wait() for child in children]
    runs.expect(codes[1] == 0, "the other run ended, too")
    folders = sorted((place / RUNS).glob("version_*"))
    runs.expect(len(folders) == 2, f"{len(folders)} run folders of 2 runs")
    for number, folder in enumerate(folders):
        alone = runs.new(f"two_{number}")
        if any((folder / "checkpoints").glob("*.ckpt")):
            shutil.copytree(folder, alone / RUNS / folder.name)
        runs.expect(runs.go_on(alone) == 0, f"it did not continue: {message(alone)}")
        runs.compare(alone)
    continued = ["fit", "--ckpt_path", "last", f"--trainer.max_steps={2 * STEPS}"]
    children = [runs.start(place, continued) for _ in range(2)]
    codes = [child.wait() for child in children]
    runs.expect(sorted(codes) == [0, 2], f"two that continue one run ended with {codes}")
    _, rows = read_csv(folders[-1] / "metrics.csv")
    iterations = [int(row["iteration"]) for row in rows]
    runs.expect(iterations == sorted(set(iterations)), "its table has rows of both")
    return "folders of their own; of two that continue one run the second ended with 2"


@contextmanager
def small_disk(place: Path, size: str) -> Iterator[None]:
    """A disk of its own at ``place`` (tmpfs).

    Raises:
        PermissionError: only root may mount one.
    """
    place.mkdir(exist_ok=True)
    if subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(place)], capture_output=True
    ).returncode:
        raise PermissionError("left out: only root may mount a disk")
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", str(place)], check=False, capture_output=True)


def remount(place: Path, options: str) -> None:
    """Change the size or mode of a disk."""
    subprocess.run(["mount", "-o", f"remount,{options}", str(place)], check=True, capture_output=True)


def begin(runs: Runs, place: Path, arguments: list[str]) -> None:
    """Begin a run, and kill it once it has a checkpoint."""
    child = runs.start(place, arguments)
    wait_for_step(child, place)
    child.kill()
    if child.wait() != -signal.SIGKILL:
        raise RuntimeError(f"it ended by itself: {message(place)}")


def refused(runs: Runs, place: Path) -> str:
    """Continue where that cannot go well: one sentence, exit code 2, checkpoints as they were."""
    before = {path.name: path.read_bytes() for path in place.glob(f"{RUNS}/version_0/checkpoints/*.ckpt")}
    code = runs.go_on(place)
    said = message(place)
    runs.expect(code == 2, f"exit code {code}: {said}")
    now = {path.name: path.read_bytes() for path in place.glob(f"{RUNS}/version_0/checkpoints/*.ckpt")}
    runs.expect(now == before, "checkpoints changed")
    return said


def continue_to_end(runs: Runs, place: Path) -> None:
    """Continue to the end, and compare."""
    runs.expect(runs.go_on(place) == 0, f"it did not continue: {message(place)}")
    runs.compare(place)


def full_disk(runs: Runs) -> str:
    """The disk fills up in the middle of a run, then has space again."""
    place = runs.folder / "full"
    with small_disk(place, "8m"):
        begin(runs, place, runs.fresh())
        free = shutil.disk_usage(place).free
        (place / "filler").write_bytes(bytes(max(free - 4096, 0)))
        said = refused(runs, place)
        (place / "filler").unlink()
        continue_to_end(runs, place)
    return said


def read_only(runs: Runs) -> str:
    """The disk becomes read-only between two halves of a run."""
    place = runs.folder / "read_only"
    with small_disk(place, "8m"):
        begin(runs, place, runs.fresh())
        remount(place, "ro")
        said = refused(runs, place)
        remount(place, "rw")
        continue_to_end(runs, place)
    return said


def small_temporary(runs: Runs) -> str:
    """A TMPDIR of 16 KiB."""
    place, temporary = runs.new("small_tmp"), runs.folder / "temporary"
    with small_disk(temporary, "16k"):
        code = runs.go_on(place, TMPDIR=str(temporary))
        left = [path.name for path in temporary.iterdir()]
    runs.expect(code == 0, message(place))
    runs.expect(not left, f"left there: {left}")
    runs.compare(place)
    return "16 KiB, nothing left there"


def closed_stderr(runs: Runs) -> str:
    """Standard error closed, as a daemon has it."""
    place = runs.new("closed")
    command = ["sh", "-c", 'exec "$@" 2>&-', "sh", *NEURAD]
    runs.expect(runs.go_on(place, command) == 0, message(place))
    runs.compare(place)
    return ""


def moved_clock(runs: Runs) -> str:
    """The wall clock jumps by ten years, back and forth, five times a second."""
    place, site = runs.new("clock"), runs.new("site")
    (site / "sitecustomize.py").write_text(_CLOCK)
    path = os.pathsep.join(filter(None, (str(site), os.environ.get("PYTHONPATH"))))
    runs.expect(runs.go_on(place, PYTHONPATH=path) == 0, message(place))
    runs.compare(place)
    return "time.time in the child is replaced"


def changed_photographs(runs: Runs) -> str:
    """A photograph is replaced during the run, which is then killed and would go on with the other one."""
    scene = runs.folder / "changing" / runs.scene.name
    shutil.copytree(runs.scene, scene)
    place = runs.new("changed")
    child = runs.start(place, runs.fresh(scene))
    wait_for_step(child, place)
    images = sorted((scene / "images").glob("train*.exr"))
    shutil.copyfile(images[1], images[0])
    child.kill()
    runs.expect(child.wait() == -signal.SIGKILL, message(place))
    said = refused(runs, place)
    shutil.copyfile(runs.scene / "images" / images[0].name, images[0])
    continue_to_end(runs, place)
    return said


ROWS: dict[str, tuple[Callable[[Runs], str], bool]] = {
    "kill -9 at random moments": (killed, True),
    "two runs at once, one killed": (beside_another, False),
    "full disk": (full_disk, False),
    "disk turned read-only": (read_only, False),
    "small TMPDIR": (small_temporary, False),
    "closed standard error": (closed_stderr, False),
    "moved clock": (moved_clock, False),
    "photographs changed during the run": (changed_photographs, False),
}
"""What happens, and whether ``--quick`` has it."""


def _case(runs: Runs, name: str) -> Case:
    row, quick = ROWS[name]

    def measure(short: bool) -> Outcome:
        runs.kills = min(runs.kills, QUICK_KILLS) if short else runs.kills
        runs.differences.clear()
        runs.undisturbed  # noqa: B018 - made before anything happens
        try:
            note = row(runs)
        except PermissionError as error:
            return Outcome(0.0, None, str(error))
        except (InputError, OSError) as error:
            return Outcome(math.nan, 0.0, str(error))
        return Outcome(float(len(runs.differences)), 0.0, "; ".join([*runs.differences, note]))

    return Case("faults", name, "the undisturbed run, to the last bit", measure, quick)


def cases() -> list[Case]:
    """Kills, disks, streams, clocks and photographs, each against the undisturbed run."""
    runs = Runs()
    return [_case(runs, name) for name in ROWS]
