"""What reading a run's own config knows of Lightning without loading it."""

import importlib
import inspect
import subprocess
import sys

import pytest

from neurad.runs.own_config import BUDGETS, TRAINER
from neurad.runs.trainer_settings import OURS, UNCHANGED


def test_what_the_trainer_takes_where_nothing_is_said_is_what_lightning_says():
    import lightning.pytorch as pl

    usual = {name: p.default for name, p in list(inspect.signature(pl.Trainer.__init__).parameters.items())[1:]}
    said = {name: value for name, value in usual.items() if value is not None and name not in TRAINER}
    assert said == UNCHANGED
    assert not (OURS.keys() | UNCHANGED.keys()) - usual.keys()


@pytest.mark.parametrize("name", BUDGETS)
def test_the_callback_that_is_taken_over_is_the_limit_of_time(name):
    from neurad.callbacks import TrainingBudget

    module, _, kind = name.rpartition(".")
    assert getattr(importlib.import_module(module), kind) is TrainingBudget


@pytest.mark.parametrize("module", ["neurad.runs.load", "neurad.export.run", "neurad.inspect.viewer"])
def test_what_reads_a_run_does_not_load_the_trainer(module):
    code = f"import sys, {module}; print([m for m in ('lightning', 'torchmetrics', 'tensorboard') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
