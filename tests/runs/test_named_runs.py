"""``--ckpt_path`` by a run's folder and by its name, and the closing lines that use it."""

import re
from pathlib import Path

import pytest
from helpers.tiny_fit import checkpoint, fails, fit, run_folder

from neurad.checkpoints.find import named_checkpoint
from neurad.cli import main
from neurad.core.errors import InputError


@pytest.mark.main
def test_a_run_is_named_by_folder_or_number(tiny, capfd):
    fit("--trainer.max_steps=4")
    out = capfd.readouterr().out
    # Someone who has read nothing goes on from the last lines.
    assert "20 dB is a typical error of 0.1" in out
    commands = re.findall(r"^  neurad (.*?)  ", out, re.M)
    assert commands[0] == "test --ckpt_path version_0"
    assert "fit --ckpt_path version_0 --trainer.max_steps 8" in commands
    assert "export --ckpt_path version_0 --out room" in commands
    main(commands[1].split())
    assert checkpoint()["neurad"]["iteration"] == 8
    last = run_folder() / "checkpoints" / "last.ckpt"
    for name in ("version_0", str(run_folder()), str(run_folder().resolve()), "lightning_logs", ".", str(last)):
        assert named_checkpoint(Path(name), Path(), "run").resolve() == last.resolve()
    assert "there are version_0" in fails(capfd, "test", "--ckpt_path", "version_7")
    assert "did you mean" in fails(capfd, "test", "--ckpt_path", "lightning_log")
    with pytest.raises(InputError, match="run x: there is no such run folder"):
        named_checkpoint(Path("nothing/x"), Path(), "run x")
