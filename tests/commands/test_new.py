"""``neurad new``: what it writes works, and it writes over nothing."""

import importlib
import sys
from pathlib import Path

import pytest
from helpers import tiny_fit

from neurad.cli import main
from neurad.integrators.direct import Direct


def test_the_files_of_a_new_method_pass_their_test_and_train(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    main(["new", "method", "my_method"])
    assert "python -m pytest test_my_method.py" in capsys.readouterr().out
    assert sorted(path.name for path in Path().iterdir()) == ["my_method.py", "my_method.yaml", "test_my_method.py"]
    monkeypatch.syspath_prepend(tmp_path)
    shown = importlib.import_module("test_my_method").test_it_is_direct_light_and_the_same_from_everywhere
    shown()
    monkeypatch.setattr(sys.modules["my_method"].MyMethod, "reflected", Direct.reflected)
    with pytest.raises(AssertionError):
        shown()
    for name in ("my_method", "test_my_method"):
        sys.modules.pop(name)
    tiny_fit.write_tiny_config()
    tiny_fit.fit("--config", "my_method.yaml", "--trust", "my_method", "--trainer.max_steps=2")
    assert "class_path: my_method.MyMethod" in (tiny_fit.run_folder() / "config.yaml").read_text()
    sys.modules.pop("my_method", None)


@pytest.mark.parametrize(
    ("name", "said"),
    [("my_method", "it exists"), ("json", "there is a module"), ("numba", "there is a module"), ("3d", "letters"),
     ("a-b", "letters"), ("class", "letters"), ("../up", "letters"), ("", "letters")],
)  # fmt: skip
def test_bad_names_are_one_sentence_and_leave_nothing(tmp_path, monkeypatch, capfd, name, said):
    monkeypatch.chdir(tmp_path)
    Path("my_method.yaml").write_text("mine")
    assert said in tiny_fit.fails(capfd, "new", "method", name)
    assert [path.read_text() for path in Path().iterdir()] == ["mine"]
