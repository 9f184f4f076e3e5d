"""What reading a run's own config knows of Lightning without loading it."""

import inspect
import subprocess
import sys

import pytest
import yaml

from neurad.runs.own_config import TRAINER, own_config
from neurad.runs.trainer_settings import OURS, UNCHANGED


def test_what_the_trainer_takes_where_nothing_is_said_is_what_lightning_says():
    import lightning.pytorch as pl

    usual = {name: p.default for name, p in list(inspect.signature(pl.Trainer.__init__).parameters.items())[1:]}
    said = {name: value for name, value in usual.items() if value is not None and name not in TRAINER}
    assert said == UNCHANGED
    assert not (OURS.keys() | UNCHANGED.keys()) - usual.keys()


@pytest.mark.parametrize("name", ["neurad.callbacks.TrainingBudget", "neurad.callbacks.budget.TrainingBudget"])
def test_a_limit_of_training_time_is_taken_over(tmp_path, name):
    budget = {"class_path": name, "init_args": {"seconds": 60.0}}
    config = {"trainer": {"callbacks": [budget], "log_every_n_steps": None}, "model": {}, "data": {}}
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(config))
    assert own_config(tmp_path).trainer.callbacks == [budget]


def test_what_reads_a_run_does_not_load_the_trainer():
    """One module after the other; what is loaded is named behind the first that loads it."""
    code = """
import importlib, sys
for name in ("neurad.runs.load", "neurad.export.run", "neurad.inspect.viewer"):
    importlib.import_module(name)
    print(name, *[m for m in ("lightning", "torchmetrics", "tensorboard") if m in sys.modules])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["neurad.runs.load", "neurad.export.run", "neurad.inspect.viewer"]
