"""The command line as a user meets it, over a module that has nothing to render."""

import csv
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
import yaml
from helpers.stand_in import StandIn, StandInData

from neurad import cli
from neurad.cli import main
from neurad.core.errors import InputError
from neurad.runs.configs import find_config, load_config, resolve, shipped_folders, split_arguments

HERE = Path(__file__).resolve().parents[1]
SCRIPT = """
import sys
sys.path.insert(0, {here!r})
from neurad import cli
def classes():
    from helpers.stand_in import StandIn, StandInData
    return StandIn, StandInData
cli._classes = classes
cli.main()
"""


@pytest.fixture(autouse=True)
def _place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(cli, "_classes", lambda: (StandIn, StandInData))


def fit(*args):
    main(["fit", "--trainer.accelerator=cpu", "--trainer.enable_progress_bar=false", *args])


def run_folder(version=0):
    return Path("lightning_logs") / f"version_{version}"


def metrics(version=0):
    with (run_folder(version) / "metrics.csv").open() as file:
        return [{k: v for k, v in row.items() if k != "seconds"} for row in csv.DictReader(file)]


def config(version=0):
    return yaml.safe_load((run_folder(version) / "config.yaml").read_text())


def fails(capfd, *args):
    """The one sentence that these arguments end with."""
    with pytest.raises(SystemExit) as stop:
        main(list(args))
    error = capfd.readouterr().err.strip()
    assert stop.value.code == 2
    assert error.startswith("neurad: error: ")
    assert "\n" not in error
    return error


# ---- help and bad input


def test_help_imports_nothing_heavy():
    code = "import sys; from neurad.cli import main; main(['-h']); print({'torch', 'lightning'} & set(sys.modules))"
    begin = time.monotonic()
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert time.monotonic() - begin < 10  # 0.1 s on an idle machine
    assert done.stdout.endswith("set()\n")
    assert all(f"  {verb} " in done.stdout for verb in ("fit", "validate", "test", "predict", "render"))


def test_no_arguments_print_the_help(capsys):
    main([])
    assert "usage: neurad VERB" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("args", "said"),
    [
        (["train"], "train"),
        (["fit", "--config"], "--config"),
        (["fit", "--config", "nothing.yaml"], "nothing.yaml"),
        (["fit", "--config", "key.yaml"], "key.yaml: modle.rate"),
        (["fit", "--config", "value.yaml"], "value.yaml: model.rate"),
        (["fit", "--config", "torn.yaml"], "torn.yaml"),
        (["fit", "--config", "list.yaml"], "list.yaml"),
        (["fit", "--config", "open.yaml"], "--data.root"),
        (["fit", "--config", "loop.yaml"], "loop.yaml"),
        (["fit", "--config", "dangling.yaml"], "nowhere"),
        (["fit", "--model.rate", "fast"], "model.rate"),
        (["fit", "--model.rat", "1"], "--model.rat"),
        (["fit"], "--trainer.max_steps"),
        (["fit", "--trainer.max_time", "soon"], "soon"),
        (["fit", "--trainer.max_steps", "2", "--trainer.accelerator", "warp"], "warp"),
        (["fit", "--trainer.logger", "os.system"], "os.system"),
        (["fit", "--trainer.max_steps=2", "--data.root", "nowhere"], "nowhere/transforms_train.json"),
        (["fit", "--ckpt_path", "last"], "--ckpt_path last"),
        (["fit", "--ckpt_path", "nothing.ckpt"], "nothing.ckpt"),
        (["fit", "--ckpt_path", "torn.yaml"], "torn.yaml"),
        (["test"], "--ckpt_path last"),
    ],
)
def test_bad_input_is_one_sentence_and_leaves_nothing(capfd, tmp_path, args, said):
    for name, text in {
        "key": "modle: {rate: 1}",
        "value": "model: {rate: fast}",
        "torn": "a: [1",
        "list": "[1, 2]",
        "open": "data:\n  root: ???",
        "loop": "base: loop.yaml",
        "dangling": "model: {rate: '${nowhere}'}",
    }.items():
        (tmp_path / f"{name}.yaml").write_text(text)
    assert said in fails(capfd, *args)
    assert not Path("lightning_logs").exists()


def test_an_error_of_the_program_keeps_its_traceback():
    with pytest.raises(RuntimeError, match="in the middle of a step"):
        fit("--trainer.max_steps=5", "--model.fail_at=2")


# ---- configs


def test_shipped_configs_are_found_from_anywhere():
    assert find_config("kitchen.yaml").is_file()
    assert find_config("paper/staircase.yaml").is_file()
    for folder in shipped_folders():
        for path in folder.rglob("*.yaml"):
            resolve(load_config(str(path.relative_to(folder))), {"data.root": "x"})


def test_a_file_here_comes_before_a_shipped_one(tmp_path):
    Path("kitchen.yaml").write_text("model: {rate: 0.5}")
    assert find_config("kitchen.yaml").resolve() == tmp_path / "kitchen.yaml"


def test_both_forms_of_arguments():
    names, values, rest = split_arguments(
        ["--config", "a", "--x.y=1", "-c", "b", "--x.z", "-2", "--config=c", "--flag"]
    )
    assert names == ["a", "b", "c"]
    assert values == {"x.y": "1", "x.z": "-2"}
    assert rest == ["--x.y=1", "--x.z=-2", "--flag"]


LOW = "seed_everything: 3\nmodel: {seed: '${seed_everything}', rate: 0.5, size: {width: 5, depth: '${.width}'}}\n"


@pytest.mark.parametrize(
    "form", [["--seed_everything=8", "--model.size.width=6"], ["--seed_everything", "8", "--model.size.width", "6"]]
)
def test_an_override_changes_what_refers_to_it(form):
    Path("low.yaml").write_text(LOW)
    fit("--config", "low.yaml", "--trainer.max_steps=2", *form)
    saved = config()
    assert saved["seed_everything"] == saved["model"]["seed"] == 8
    assert saved["model"]["size"] == {"width": 6, "depth": 6}


def test_configs_overlay_each_other():
    Path("low.yaml").write_text(LOW)
    Path("high.yaml").write_text("seed_everything: 4\nmodel: {size: {width: 7}}\ntrainer: {max_steps: 2}")
    fit("--config", "low.yaml", "--config", "high.yaml")
    saved = config()
    assert saved["model"] | {"size": None} == saved["model"] | {"size": None, "seed": 4, "rate": 0.5}
    assert saved["model"]["size"] == {"width": 7, "depth": 7}


def test_base_lies_under_the_file_that_names_it():
    Path("low.yaml").write_text(LOW)
    Path("top.yaml").write_text("base: low.yaml\nmodel: {rate: 0.25}")
    (tree_low, tree_top) = resolve(load_config("top.yaml"), {})
    assert tree_low["model"]["rate"] == 0.5
    assert tree_top == {"model": {"rate": 0.25}}


# ---- runs


def test_run_folder_and_closing_table(capsys):
    fit("--trainer.max_steps=40", "--evaluation.every_n_steps=15")
    names = {p.name.split(".")[0] for p in run_folder().iterdir()}
    assert names == {"config", "metrics", "events", "checkpoints"}
    assert [row["iteration"] for row in metrics()] == ["15", "30", "40"]
    assert [row["rays"] for row in metrics()] == ["150", "300", "400"]
    out = capsys.readouterr().out
    assert "best constant" in out
    assert f"run folder {run_folder()}" in out
    state = torch.load(run_folder() / "checkpoints" / "last.ckpt", weights_only=True)
    assert state["neurad"]["iteration"] == 40
    assert len(state["optimizer_states"]) == 2


def test_steps_alone_make_a_fixed_schedule():
    fit("--trainer.max_steps=60")
    assert [int(row["iteration"]) for row in metrics()] == list(range(3, 61, 3))


def test_max_time_ends_the_run_and_evaluations_keep_to_their_share():
    fit("--trainer.max_time=00:00:00:02", "--model.sleep=0.01", "--evaluation.fraction=0")
    assert len(metrics()) == 1  # the one at the end, which is always made
    state = torch.load(run_folder() / "checkpoints" / "last.ckpt", weights_only=True)
    assert 0 < state["neurad"]["iteration"] == int(metrics()[0]["iteration"]) <= 200


def test_continuing_gives_what_one_run_gives():
    steps = ["--evaluation.every_n_steps=10"]
    fit("--trainer.max_steps=40", *steps)
    fit("--trainer.max_steps=40", *steps, "--model.interrupt_at=-1")
    with pytest.raises(SystemExit) as stop:
        fit("--trainer.max_steps=40", *steps, "--model.interrupt_at=25")
    assert stop.value.code == 130
    assert signal.getsignal(signal.SIGINT) is not signal.SIG_IGN
    assert [row["iteration"] for row in metrics(2)] == ["10", "20"]
    fit("--ckpt_path", "last", "--model.interrupt_at=-1")
    assert metrics(2) == metrics(1) == metrics(0)
    assert not run_folder(3).exists()


def test_the_command_line_beats_the_run_it_continues():
    fit("--trainer.max_steps=10", "--model.rate=0.5")
    fit("--ckpt_path=last", "--trainer.max_steps=20")
    assert config()["model"]["rate"] == 0.5
    fit("--ckpt_path=last", "--trainer.max_steps=30", "--model.rate=0.25")
    assert config()["model"]["rate"] == 0.25
    assert metrics()[-1]["iteration"] == "30"


def test_a_failed_continuation_changes_nothing(capfd):
    fit("--trainer.max_steps=10")
    before = {p: (p.stat().st_mtime_ns, p.stat().st_size) for p in run_folder().rglob("*") if p.is_file()}
    fails(capfd, "fit", "--ckpt_path=last", "--trainer.max_steps=20", "--data.root=nowhere")
    assert before == {p: (p.stat().st_mtime_ns, p.stat().st_size) for p in run_folder().rglob("*") if p.is_file()}


def test_no_checkpoint_from_the_middle_of_a_step():
    with pytest.raises(RuntimeError):
        fit("--trainer.max_steps=9", "--model.fail_at=5", "--checkpoint.every_seconds=0")
    state = torch.load(run_folder() / "checkpoints" / "last.ckpt", weights_only=True)
    assert state["neurad"]["iteration"] == 5
    assert not list(run_folder().rglob("*.part"))


def test_validate_test_and_predict(capsys):
    fit("--trainer.max_steps=10")
    before = (run_folder() / "config.yaml").read_text()
    capsys.readouterr()
    main(["validate"])
    assert "best constant" in capsys.readouterr().out
    assert not (run_folder() / "images").exists()
    main(["test", "--ckpt_path", "last"])
    assert '"iteration": 10' in (run_folder() / "metrics.json").read_text()
    assert (run_folder() / "images" / "000_albedo.exr").is_file()
    (run_folder() / "images" / "000_albedo.exr").unlink()
    main(["predict"])
    assert (run_folder() / "images" / "000_albedo.exr").is_file()
    assert (run_folder() / "config.yaml").read_text() == before
    assert not run_folder(1).exists()


def test_a_killed_run_continues_exactly():
    command = [sys.executable, "-c", SCRIPT.format(here=str(HERE)), "fit", "--trainer.enable_progress_bar=false"]
    steps = ["--trainer.max_steps=150", "--evaluation.every_n_steps=7", "--checkpoint.every_seconds=0.05"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    fit(*steps)
    process = subprocess.Popen([*command, *steps, "--model.sleep=0.01"], env=environment, stdout=subprocess.DEVNULL)
    checkpoint = run_folder(1) / "checkpoints" / "last.ckpt"
    end = time.monotonic() + 60
    while not checkpoint.is_file() and time.monotonic() < end:
        time.sleep(0.02)
    time.sleep(0.4)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    assert 0 < torch.load(checkpoint, weights_only=True)["neurad"]["iteration"] < 150
    fit("--ckpt_path=last", "--model.sleep=0")
    assert metrics(1) == metrics(0)


def test_an_unknown_interpolation_names_itself():
    Path("a.yaml").write_text("model: {rate: '${nowhere}'}")
    with pytest.raises(InputError, match="nowhere"):
        resolve(load_config("a.yaml"), {})


SHIPPED = sorted(str(path.relative_to(d)) for d in shipped_folders() for path in d.rglob("*.yaml"))


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_configs_fit_the_real_classes(monkeypatch, capsys, name):
    from datamodules.scene_data import SceneData
    from neurad.training.inverse import InverseRenderer

    monkeypatch.setattr(cli, "_classes", lambda: (InverseRenderer, SceneData))
    names = ["--config", "scene.yaml", "--config", name]  # some are overlays, for use on top of another config
    with pytest.raises(SystemExit) as stop:
        main(["fit", *names, "--data.root=DIR", "--seed_everything=5", "--print_config"])
    assert stop.value.code == 0
    printed = yaml.safe_load(capsys.readouterr().out)
    assert printed["model"]["seed"] == printed["data"]["seed"] == 5
    if name == "paper/staircase.yaml":
        assert printed["model"]["sampling"]["cached_spp"] == printed["model"]["sampling"]["spp"] == 16
        assert (printed["trainer"]["max_steps"], printed["data"]["patch_size"]) == (18000, 128)
        assert printed["model"]["radiance"]["grid"]["finest"] == 65536
