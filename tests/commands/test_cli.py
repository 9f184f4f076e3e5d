"""The command line as a user meets it: help, and mistakes in what is typed."""

import subprocess
import sys
import time
from pathlib import Path

import pytest
from helpers.tiny_fit import fails, fit

from neurad import cli
from neurad.cli import main
from neurad.core.errors import InputError
from neurad.training.inverse import InverseRenderer


def test_help_imports_nothing_heavy():
    code = "import sys; from neurad.cli import main; main(['-h']); print({'torch', 'lightning'} & set(sys.modules))"
    begin = time.monotonic()
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert time.monotonic() - begin < 10  # 0.1 s on an idle machine
    assert done.stdout.endswith("set()\n")
    assert all(f"  {verb} " in done.stdout for verb in ("fit", "validate", "test", "predict", "render"))


@pytest.mark.main
def test_no_arguments_print_the_help(capsys):
    main([])
    assert "usage: neurad VERB" in capsys.readouterr().out


FILES = {
    "key": "modle: {seed: 1}",
    "value": "model: {objective: {epsilon: fast}}",
    "torn": "a: [1",
    "list": "[1, 2]",
    "open": "data:\n  root: ???",
    "loop": "base: loop.yaml",
    "dangling": "model: {objective: {epsilon: '${nowhere}'}}",
}


@pytest.mark.main
@pytest.mark.parametrize(
    ("args", "said"),
    [
        (["train"], "train"),
        (["fti"], "did you mean fit"),
        (["fit", "--config", "kichen.yaml"], "did you mean kitchen.yaml?"),
        (["fit", "--config", "methods/ourz.yaml"], "did you mean methods/ours.yaml?"),
        (["fit", "--config", "tinny.yaml"], "did you mean tiny.yaml?"),
        (["fit", "--model.sampling.ssp", "4"], "did you mean model.sampling.spp?"),
        (["fit", "--config", "tiny.yaml", "--trainer.max_steps=2", "--data.scene=cornel"], "did you mean cornell?"),
        (["render", "--scene", "cornell", "--out", "x", "--integrator", "pth"], "did you mean path?"),
        (["stress", "--only", "ligt"], "did you mean light?"),
        (["bench", "steps"], "did you mean step?"),
        (["data", "colmpa", "x", "--out", "y"], "did you mean colmap?"),
        (["render", "--sceen", "cornell", "--out", "x"], "--scene"),
        (["compare", "--config", "tiny.yaml", "--bugdet", "60s"], "did you mean --budget?"),
        (
            ["compare", "--config", "tiny.yaml", "--methods", "prb", "--budget", "soon"],
            "soon is not a time, such as 60s",
        ),
        (["fit", "--config"], "--config"),
        (["fit", "--config", "nothing.yaml"], "nothing.yaml"),
        (["fit", "--config", "key.yaml"], "key.yaml: modle.seed"),
        (["fit", "--config", "value.yaml"], "value.yaml: model.objective.epsilon"),
        (["fit", "--config", "torn.yaml"], "torn.yaml"),
        (["fit", "--config", "list.yaml"], "list.yaml"),
        (["fit", "--config", "open.yaml"], "--data.root"),
        (["fit", "--config", "loop.yaml"], "loop.yaml"),
        (["fit", "--config", "dangling.yaml"], "nowhere"),
        (
            ["fit", "--config", "tiny.yaml", "--trainer.max_steps=1", "--trainer.default_root_dir=~nosuchuser"],
            "--trainer.default_root_dir ~nosuchuser",
        ),
        (["fit", "--ckpt_path", "~nosuchuser/last.ckpt"], "--ckpt_path ~nosuchuser/last.ckpt"),
        (["fit", "--model.objective.epsilon", "fast"], "--model.objective.epsilon: fast is not a number"),
        (["fit", "--model.albedo.kind", "sparse"], "--model.albedo.kind: sparse is none of hash, dense"),
        (["fit", "--model.radiance.inputs", "[5]"], "--model.radiance.inputs: 5 is not a text"),
        (["fit", "--model.sampling", "5"], "--model.sampling: it is a group of settings"),
        (
            ["fit", "--config", "tiny.yaml", "--model.method.k", "x"],
            "--model.method.init_args.k: x is not a whole number",
        ),
        (["fit", "--trainer.logger", "CSVLogger"], "CSVLogger cannot be made without its init_args save_dir"),
        (["fit", "--trainer.callbacks", "[TrainingBudget]"], "--trainer.callbacks"),
        (["fit", "--trainer.max_steps=1", "--trainer.accelerator=tpu"], "trainer: "),
        (
            ["fit", "--model.method", '{"class_path": "neurad.integrators.prb.PRB", "dict_kwargs": {"z": 1}}'],
            "neurad.integrators.prb.PRB has no setting z",
        ),
        (["fit", "--model.objective.epsilo", "1"], "model.objective.epsilo"),
        (["fit"], "--trainer.max_steps"),
        (["fit", "--trainer.max_time", "soon"], "soon"),
        (["fit", "--trainer.max_steps", "2", "--trainer.accelerator", "warp"], "warp"),
        (["fit", "--trainer.logger", "os.system"], "os.system"),
        (["fit", "--trainer.max_steps=2", "--data.root", "nowhere"], "nowhere"),
        (["fit", "--ckpt_path", "last"], "--ckpt_path last"),
        (["fit", "--ckpt_path", "nothing.ckpt"], "nothing.ckpt"),
        (["fit", "--ckpt_path", "version_3"], "--ckpt_path version_3: there is no such run folder or checkpoint"),
        (["test", "--ckpt_path", "."], "it has no checkpoint"),
        (["fit", "--ckpt_path", "torn.yaml"], "torn.yaml"),
        (["test"], "--ckpt_path last"),
    ],
)
def test_bad_input_is_one_sentence_and_leaves_nothing(tiny, capfd, args, said):
    for name, text in FILES.items():
        Path(f"{name}.yaml").write_text(text)
    assert said in fails(capfd, *args)
    assert not Path("lightning_logs").exists()


@pytest.mark.main
@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("seed_everything=-1", "--seed_everything: -1 is out of range"),
        ("trainer.accumulate_grad_batches=2", "--data.patches"),
        ("trainer.limit_train_batches=0.5", "--trainer.max_steps"),
        ("trainer.devices=-3", "--trainer.devices: -3"),
        ("trainer.devices=1000", "--trainer.devices: 1000 processes"),
        ("model.optimization.albedo=.nan", "--model.optimization.albedo: nan is out of range, it must be at least 0"),
        ("model.method.init_args.k=0", "--model.method.init_args.k: 0 is out of range, it must be at least 1"),
        ("data.patches=0", "--data.patches"),
        ("data.scene=ktchen", "ktchen"),
        ("model.optimization.matmul=low", "model.optimization.matmul"),
        ("model.albedo.grid.levels=0", "levels"),
        ("model.albedo.grid.coarsest=16", "coarsest"),
        ("model.albedo.kind=sparse", "model.albedo"),
        ("model.radiance.inputs=[colour]", "colour"),
        ("model.method=neurad.integrators.nothing.Nothing", "Nothing"),
        ("model.tracer=optix", "optix"),
        ("trainer.precision=16-mixed", "precision"),
    ],
)
def test_a_setting_out_of_range_is_named_and_leaves_nothing(tiny, capfd, setting, said):
    assert said in fails(capfd, "fit", "--config", "tiny.yaml", "--trainer.max_steps=2", f"--{setting}")
    assert not Path("lightning_logs").exists()


@pytest.mark.main
def test_an_error_of_the_program_keeps_its_traceback(tiny, monkeypatch):
    def broken(self, batch, index):
        raise RuntimeError("a bug in a step")

    monkeypatch.setattr(InverseRenderer, "training_step", broken)
    with pytest.raises(RuntimeError, match="a bug in a step"):
        fit("--trainer.max_steps=5")


def test_an_import_that_ctrl_c_ends_is_an_interruption(monkeypatch, capsys):
    """A package may turn it into an error of its own, from which a sentence about a missing package would be made."""

    def stopped(*_, **__):
        try:
            try:
                raise KeyboardInterrupt
            except KeyboardInterrupt as error:
                raise ImportError("no extension") from error
        except ImportError as error:
            raise InputError("reading it needs the package") from error

    monkeypatch.setattr(cli, "_dispatch", stopped)
    with pytest.raises(SystemExit) as caught:
        cli.main(["check"])
    assert caught.value.code == 130
    assert "interrupted" in capsys.readouterr().err
