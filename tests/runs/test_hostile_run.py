"""A run that somebody sent: nothing of it is executed, and no file outside its folder is written."""

import os
import pickle
import socket
import sys
from pathlib import Path

import pytest
import torch
import yaml
from helpers.listening import listening
from helpers.tiny_fit import checkpoint, config, fails, fit, run_folder, tree

import neurad
from neurad.cli import main
from neurad.core.errors import InputError


@pytest.fixture
def place(fitted_box, tmp_path, monkeypatch):
    """A run to spoil, as it was sent; a module ``evil`` lies beside it, as it would on ``sys.path``."""
    Path("evil.py").write_text("open('executed', 'w').close()\nclass Evil:\n    pass\n")
    monkeypatch.syspath_prepend(str(fitted_box))
    yield fitted_box
    sys.modules.pop("evil", None)
    assert not list(tmp_path.rglob("executed"))


def spoil(change):
    path = run_folder() / "config.yaml"
    tree = config()
    change(tree)
    path.write_text(yaml.safe_dump(tree))


def logger(name):
    return {"class_path": f"lightning.pytorch.loggers.{name}", "init_args": {"save_dir": "elsewhere"}}


ELSEWHERE = {
    "default_root_dir": "elsewhere",
    "logger": [logger("CSVLogger"), logger("TensorBoardLogger")],
    "callbacks": [
        {"class_path": "lightning.pytorch.callbacks.ModelCheckpoint", "init_args": {"dirpath": "elsewhere"}},
        {"class_path": "neurad.callbacks.TrainingBudget", "init_args": {"seconds": 100.0}},
    ],
    "profiler": {"class_path": "lightning.pytorch.profilers.AdvancedProfiler", "init_args": {"dirpath": "elsewhere"}},
    "plugins": {"class_path": "lightning.pytorch.plugins.io.TorchCheckpointIO"},
    "strategy": {"class_path": "evil.Evil"},
    "fast_dev_run": True,
}


def test_its_config_chooses_no_place_to_write(place, capfd):
    before = tree(place)
    spoil(lambda tree: tree["trainer"].update(ELSEWHERE))
    main(["fit", "--ckpt_path=last", "--trainer.max_steps=3"])
    assert checkpoint()["neurad"]["iteration"] == 3
    main(["test"])
    said = capfd.readouterr().err
    assert all(f"trainer.{name}" in said for name in ELSEWHERE)
    made = tree(place.parent).keys() - {f"{place.name}/{name}" for name in before}
    assert made
    assert all(name.startswith(f"{place.name}/lightning_logs/version_0/") for name in made)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda tree: tree["model"].update(method={"class_path": "evil.Evil"}), "model.method names evil.Evil"),
        (lambda tree: tree["model"].update(method={"class_path": "neurad.__main__.main"}), "neurad.__main__"),
        (lambda tree: tree["model"].update(method="other.yaml"), "model.method names other.yaml"),
        (lambda tree: tree["model"].update(sampling="/dev/zero"), "model.sampling is not a group"),
        (lambda tree: tree["model"]["albedo"].update(grid="/dev/zero"), "model.albedo.grid is not a group"),
        (lambda tree: tree.update(evaluation={"class_path": "evil.Evil"}), "evaluation names a class, evil.Evil"),
        (lambda tree: tree["data"].update(root="${oc.env:HOME}"), "data.root refers to something else"),
        (lambda tree: tree.update(base="/dev/zero"), "it has a base"),
        (lambda tree: tree.update(trainer="other.yaml"), "trainer is not a group"),
        (lambda tree: tree.update(seed_everything=-1), "seed_everything"),
    ],
)
def test_its_config_names_no_class_and_no_other_file(place, capfd, change, said):
    spoil(change)
    before = tree(place)
    assert said in fails(capfd, "fit", "--ckpt_path=last")
    with pytest.raises(InputError, match=r"config\.yaml|trainer is not"):
        neurad.load()
    assert tree(place) == before


def test_its_config_with_tags_is_not_constructed(place, capfd):
    path = run_folder() / "config.yaml"
    path.write_text(path.read_text() + "evil: !!python/object/apply:os.system ['touch executed']\n")
    assert "config.yaml" in fails(capfd, "test")
    with pytest.raises(InputError, match="not readable YAML"):
        neurad.load()


class Touch:
    """Executes a command where it is unpickled."""

    def __reduce__(self):
        return os.system, ("touch executed",)


@pytest.mark.parametrize("form", ["torch", "pickle", "hyper_parameters"])
def test_its_checkpoint_is_not_executed(place, capfd, form):
    path = Path("torn.ckpt")
    if form == "torch":
        torch.save({"state_dict": {}, "evil": Touch()}, path)
    elif form == "pickle":
        path.write_bytes(pickle.dumps({"state_dict": Touch()}))
    else:  # Lightning would make the class that these name
        state = torch.load(run_folder() / "checkpoints" / "last.ckpt", weights_only=True)
        state["hyper_parameters"] = {"_class_path": "evil.Evil", "_instantiator": "evil.Evil"}
        torch.save(state, path)
    before = tree(place)
    assert "torn.ckpt" in fails(capfd, "test", "--config=tiny.yaml", f"--ckpt_path={path}")
    assert tree(place) == before


@pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="reads Linux's list of sockets")
def test_a_fit_listens_nowhere(place, monkeypatch):
    from neurad.training.inverse import InverseRenderer

    seen, step = [], InverseRenderer.training_step

    def spied(self, batch, index):
        seen.append(listening("self"))
        return step(self, batch, index)

    with socket.create_server(("127.0.0.1", 0)):  # the test of the test
        assert listening("self") == ["0100007F"]
    monkeypatch.setattr(InverseRenderer, "training_step", spied)
    fit("--trainer.max_steps=2")
    assert seen == [[]] * 2
