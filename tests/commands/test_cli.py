"""The command line as a user meets it: help, and mistakes in what is typed."""

import subprocess
import sys
import time

import pytest
from helpers.tiny_fit import fit

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
