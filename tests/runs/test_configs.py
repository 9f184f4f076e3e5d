"""Config files: where they are found, how they overlay each other, and what the shipped ones say."""

import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import pytest
import yaml
from helpers.tiny_fit import checkpoint, config, fails, fit, leaves, printed_config, write_tiny_config

import neurad
from neurad.assembly.settings import Objective, Optimization, Sampling
from neurad.callbacks import Evaluate
from neurad.runs.configs import find_config, shipped_folders
from neurad.runs.own_config import own_config

SHIPPED = sorted(str(path.relative_to(d)) for d in shipped_folders() for path in d.rglob("*.yaml"))
WITHOUT_FIELD = [f"methods/{name}.yaml" for name in ("direct", "path", "prb")]
OVERLAYS = [name for name in SHIPPED if name.startswith(("methods/", "ablations/")) or name == "dense.yaml"]


def own(name):
    """What a shipped config file itself says, without its base."""
    return leaves(yaml.safe_load(find_config(name).read_text()))


# ---- files


def test_a_file_here_comes_before_a_shipped_one(place):
    Path("kitchen.yaml").write_text("model: {materials: known}")
    assert find_config("kitchen.yaml").resolve() == place / "kitchen.yaml"


# ---- overlays

LOW = {
    "seed_everything": 3,
    "model": {"albedo": {"width": 5, "hidden_layers": "${.width}"}},
}


@pytest.mark.parametrize(
    ("words", "seed", "width"),
    [
        ("--seed_everything=8 --model.albedo.width=6", 8, 6),
        ("--seed_everything 8 --model.albedo.width 6", 8, 6),
        ("--config high.yaml", 4, 7),
    ],
)
def test_an_override_or_an_overlay_changes_what_refers_to_it(tiny, monkeypatch, words, seed, width):
    seeds = []
    look = lambda _, trainer, module: seeds.extend((module.settings.seed, trainer.datamodule.seed))  # noqa: E731
    monkeypatch.setattr(Evaluate, "on_fit_start", look)
    Path("low.yaml").write_text(yaml.safe_dump(LOW))
    Path("high.yaml").write_text("seed_everything: 4\nmodel: {albedo: {width: 7}}")
    fit("--config", "low.yaml", "--trainer.max_steps=2", *words.split())
    saved = config()
    assert [*seeds, saved["seed_everything"], neurad.load().settings.seed] == [seed] * 4
    assert saved["model"]["albedo"]["width"] == saved["model"]["albedo"]["hidden_layers"] == width
    assert saved["model"]["roughness"]["width"] == 8  # what nobody names stays
    assert checkpoint()["state_dict"]["materials.fields.albedo.mlp.layers.0.weight"].shape[0] == width


# ---- what is shipped


def has_what_is_said(found, name, but=()):
    for key, value in own(name).items():
        if not str(value).startswith("${") and key not in ("base", "seed_everything", "data.root", *but):
            assert found[key] == (float(value) if isinstance(found[key], float) else value), key


@pytest.mark.parametrize("name", [name for name in SHIPPED if name not in OVERLAYS])
def test_every_shipped_config_resolves(name):
    names = ["--config", "scene.yaml", "--config", name]  # some are overlays, for use on top of another config
    printed = printed_config(*names, "--data.root=DIR", "--seed_everything=5")
    assert printed["seed_everything"] == 5
    has_what_is_said(leaves(printed), name)


@pytest.mark.parametrize("name", OVERLAYS)
def test_every_overlay_trains_on_top_of_the_paper_s_settings(tiny, name):
    write_tiny_config(base="paper.yaml", data={"root": None, "scene": "cornell", "patch_size": 4})
    sizes = {"model.albedo.grid.finest": 8, "model.radiance.grid.finest": 8}
    fit("--config", name, "--trainer.max_steps=2", *(f"--{key}={value}" for key, value in sizes.items()))
    state, saved = checkpoint(), leaves(config())
    assert state["neurad"]["iteration"] == 2
    assert len(state["optimizer_states"]) == (1 if name in WITHOUT_FIELD else 2)
    assert saved["model.objective.estimator"] == "two_pass"
    biases = [v for k, v in state["state_dict"].items() if k.startswith("materials.") and k.endswith("bias")]
    assert any(float(v.abs().max()) > 0 for v in biases) or name == "dense.yaml"  # they start at zero
    has_what_is_said(saved, name, sizes)


# ---- the paper's settings, and ours on top

TABLE_1 = {
    "staircase": (16, 128, 18000),
    "kitchen": (64, 64, 32000),
    "living-room-2": (64, 64, 32000),
    "veach-ajar": (64, 64, 32000),
}
SECTION_5 = {
    **{f"model.{part}.grid.{key}": value for part in ("albedo", "roughness", "radiance")
       for key, value in {"levels": 16, "coarsest": 2, "finest": 2**16, "log2_size": 17}.items()},
    **{f"model.{part}.{key}": value for part, layers in (("albedo", 1), ("roughness", 1), ("radiance", 3))
       for key, value in {"width": 256, "hidden_layers": layers, "kind": "hash"}.items()},
    "model.radiance.inputs": ["direction", "normal", "albedo"],
    "model.roughness.reads_albedo": False,
    "model.method.class_path": "neurad.integrators.radiometric.Radiometric",
    "model.method.init_args.k": 1,
    "model.method.init_args.control_variate": False,
    **{f"model.optimization.{name}": 5e-4 for name in ("albedo", "roughness", "radiance")},
    "model.optimization.schedule": "constant",
    "model.optimization.average": 0.0,
    "model.optimization.roughness_decay": 0.0,
    "model.roughness.begin": "middle",
    "model.roughness.structure": "free",
    "model.sampling.focus": 0.0,
    "model.objective.estimator": "two_pass",
    "model.objective.normaliser": "photograph",
    "model.objective.prior_gradient": "full",
    "model.objective.prior_trains": "field",
    "model.objective.prior": 1.0,
    "model.objective.lhs": 1.0,
    "model.objective.epsilon": 0.01,
    "model.objective.fireflies": "keep",
    "model.sampling.extra_bounce_fraction": 1.0,
    "model.sampling.field_fraction": 1.0,
    "model.sampling.samples_per_vertex": 1,
    "model.sampling.cached_spp": 0,
    "model.sampling.guide": 0,
    "model.sampling.specular_fraction": 0.5,
    "data.patches": 1,
    "trainer.max_time": None,
}  # fmt: skip


@pytest.mark.parametrize("scene", TABLE_1)
def test_the_paper_s_settings(scene):
    spp, patch_size, steps = TABLE_1[scene]
    printed = leaves(printed_config("--config", f"paper/{scene}.yaml", "--data.root=DIR"))
    assert {key: printed[key] for key in SECTION_5} == SECTION_5
    assert printed["trainer.max_steps"] == steps
    assert printed["data.patch_size"] == patch_size
    assert printed["model.sampling.spp"] == spp
    # Every sample is independent of every other: as many groups as samples.
    assert printed["model.sampling.sample_groups"] == spp
    assert Sampling(spp=spp, cached_spp=0, sample_groups=spp).groups == spp


def test_the_base_leaves_nothing_of_the_method_to_defaults():
    paper = own("paper.yaml")
    for part, settings in (("sampling", Sampling), ("objective", Objective), ("optimization", Optimization)):
        named = {key.removeprefix(f"model.{part}.") for key in paper if key.startswith(f"model.{part}.")}
        expected = {field.name for field in fields(settings)}
        assert named == expected - {"matmul", "cuda_graph"}  # what changes nothing there


def test_what_is_ours_stands_in_one_list_on_top_of_the_paper():
    paper, ours = own("paper.yaml"), own("scene.yaml")
    assert ours.pop("base") == "paper.yaml"
    assert ours.pop("trainer.max_time") == "00:00:30:00"  # where the paper counts steps
    assert ours.keys() <= paper.keys()
    assert not [key for key in ours if ours[key] == paper[key]]


# ---- A setting that does not exist: one sentence that says where it stands and which one was probably meant


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("data: {patchs: 3}", "data.patchs is not a known setting, did you mean data.patches?"),
        (
            "modell: {sampling: {spp: 3}}",
            "modell.sampling.spp is not a known setting, did you mean model.sampling.spp?",
        ),
        ("evaluation: {share: 3}", "evaluation.share is not a known setting"),  # no neighbour is taken for it
        ("base: 5", "base must be the name of a config, or a list of names"),
        ("base: ${data.scene}", "base must be the name of a config, or a list of names"),
        ("evaluation: null", "evaluation: it is a group of settings, write them below it"),
        ("model: {sampling: {spp: null}}", "model.sampling.spp: null is no value for it, leave it out"),
        ("model: {radiance: {grid: 5}}", "model.radiance.grid: it is a group of settings, write them below it"),
        ("data: 5", "data: it is a group of settings, write them below it"),
        ("trainer: {max_time: soon}", "trainer.max_time: soon is not a time, such as 60s, 4m, 1h30m or DD:HH:MM:SS"),
        ("trainer: 5", "trainer: it is a group of settings, write them below it"),
        ("data: " + "[" * 500 + "]" * 500, "it is nested too deeply to be a config"),
    ],
)
def test_a_key_in_a_config_file(tmp_path, capfd, text, said):
    (tmp_path / "mine.yaml").write_text(text)
    sentence = fails(capfd, "fit", "--config", "cornell.yaml", "--config", tmp_path / "mine.yaml")
    assert sentence == f"neurad: error: config {tmp_path / 'mine.yaml'}: {said}"


def test_a_launcher_s_variable_that_is_no_number(capfd, monkeypatch):
    monkeypatch.setenv("LOCAL_RANK", "x")
    said = "neurad: error: the environment variable LOCAL_RANK is 'x', not a whole number; unset it"
    assert fails(capfd, "fit", "--config", "cornell.yaml") == said


# ---- a limit of time is a text, on the command line and in configs


def test_a_limit_of_time_of_the_command_line_and_of_configs(tiny):
    Path("mine.yaml").write_text(yaml.safe_dump({"base": "tiny.yaml", "trainer": {"max_time": "1h30m"}}))
    assert printed_config("--config", "mine.yaml")["trainer"]["max_time"] == "1h30m"
    assert printed_config("--config", "mine.yaml", "--trainer.max_time", "90s")["trainer"]["max_time"] == "90s"


# ---- a run's own config


@pytest.mark.parametrize("name", ["neurad.callbacks.TrainingBudget", "neurad.callbacks.budget.TrainingBudget"])
def test_a_limit_of_training_time_is_taken_over(tmp_path, name):
    budget = {"class_path": name, "init_args": {"seconds": 60.0}}
    config = {"trainer": {"callbacks": [budget]}, "model": {}, "data": {}}
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(config))
    assert own_config(tmp_path).trainer.callbacks == [budget]


def test_what_reads_a_run_does_not_load_the_trainer_and_fields_no_compiler():
    """One module after the other; what is loaded is named behind the first that loads it."""
    fields = ["optim.sparse_row_adam", "fields.radiance", "fields.material"]
    names = [*fields, "runs.load", "export.run", "inspect.viewer"]
    code = f"""
import importlib, sys
for name in {names}:
    importlib.import_module("neurad." + name)
    heavy = ["lightning", "torchmetrics", "tensorboard"] + ["numba"] * (name in {fields})
    print(name, *[m for m in heavy if m in sys.modules])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == names
