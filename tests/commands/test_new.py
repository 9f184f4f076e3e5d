"""``neurad new``: what it writes works, and it writes over nothing."""

import importlib
import inspect
import sys
from pathlib import Path

import pytest
import torch
from helpers import tiny_fit
from helpers.tiny_scene import read_json, write_scene

import neurad
from neurad.cli import main
from neurad.commands.new import KINDS
from neurad.formats.cameras.nerf import Split
from neurad.integrators.direct import Direct

WITHOUT = {
    "method": ("MyMethod", "reflected", Direct.reflected),
    "field": ("Waves", "forward", lambda self, x: torch.zeros(len(x), self.channels)),
    "reader": ("MyReader", "views", lambda self, folder, hold_out, pictures: Split([], [])),
}
"""Class and function of a template without which its test fails."""


def passes(module, tmp_path):
    (test,) = (value for name, value in vars(module).items() if name.startswith("test_"))
    test(*([tmp_path] if inspect.signature(test).parameters else []))


@pytest.mark.parametrize("kind", KINDS)
def test_the_files_of_a_new_class_pass_their_test_and_train(kind, tmp_path, monkeypatch, capsys):
    name = f"my_{kind}"
    monkeypatch.chdir(tmp_path)
    main(["new", kind, name])
    said = capsys.readouterr().out
    assert f"python -m pytest test_{name}.py" in said
    assert f"--config {name}.yaml" in said
    assert sorted(path.name for path in Path().iterdir()) == [f"{name}.py", f"{name}.yaml", f"test_{name}.py"]
    monkeypatch.syspath_prepend(tmp_path)
    test = importlib.import_module(f"test_{name}")
    passes(test, tmp_path)
    owner, function, other = WITHOUT[kind]
    monkeypatch.setattr(getattr(sys.modules[name], owner), function, other)
    with pytest.raises(AssertionError):
        passes(test, tmp_path)
    for module in (name, f"test_{name}"):
        sys.modules.pop(module)
    tiny_fit.write_tiny_config(**({"base": "scene.yaml", "data": {"root": "room"}} if kind == "reader" else {}))
    if kind == "reader":
        write_cameras(write_scene(Path("room")))
    warn = "--model.lighting.lamp_mismatch=warn"  # photographs of noise
    tiny_fit.fit("--config", f"{name}.yaml", "--trust", name, "--trainer.max_steps=2", warn)
    capsys.readouterr()
    assert f"class_path: {name}.My{kind.title()}" in (tiny_fit.run_folder() / "config.yaml").read_text()
    main(["test", "--trust", name, "--trainer.enable_progress_bar=false"])
    assert f"neurad view --ckpt_path version_0 --trust {name}" in capsys.readouterr().out
    assert len(neurad.load(trust=name).scene.train) == (4 if kind == "reader" else 8)
    sys.modules.pop(name, None)


def write_cameras(folder):
    """The cameras of a scene folder as the template of a reader has them, in place of those that neurad knows."""
    lines = []
    for part in ("train", "test"):
        for frame in read_json(folder, part)["frames"]:
            numbers = [50.0, *(x for row in frame["transform_matrix"] for x in row)]
            lines.append(",".join(map(str, [frame["file_path"], *numbers])))
        (folder / f"transforms_{part}.json").unlink()
    (folder / "cameras.csv").write_text("\n".join(lines))


@pytest.mark.parametrize(
    ("name", "said"),
    [("my_method", "it exists"), ("json", "there is a module"), ("numba", "there is a module"), ("3d", "letters"),
     ("a-b", "letters"), ("class", "letters"), ("../up", "letters"), ("", "letters")],
)  # fmt: skip
def test_bad_names_are_one_sentence_and_leave_nothing(place, capfd, name, said):
    Path("my_method.yaml").write_text("mine")
    assert said in tiny_fit.fails(capfd, "new", "method", name)
    assert [path.read_text() for path in Path().iterdir()] == ["mine"]
