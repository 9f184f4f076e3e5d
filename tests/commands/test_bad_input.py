"""Every bad input as a user meets it, and words that cannot be meant: one sentence that names the file or option, exit
code 2, nothing written. What is wrong with files has tables beside their readers."""

import gc
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.spoil import as_floor, nothing, photograph, removed, replaced, written
from helpers.tiny_fit import fails, fit, tree
from helpers.tiny_scene import XML

from neurad import cli
from neurad.cli import main
from neurad.core.errors import InputError
from neurad.training.inverse import InverseRenderer

FIT = ["fit", "--config", "tiny.yaml", "--trainer.max_steps=2", "--model.lighting.lamp_mismatch=warn"]


EMITTER = XML[XML.index("<emitter") : XML.index("</emitter>") + 10]
GO_ON = ["--ckpt_path=last", "--trainer.max_steps=4"]
BAD = {
    "NaN pixels of a held-out view": (
        lambda folder: photograph(np.nan, "test_1")(folder / "room"), [], ["test_1.exr", "NaN"]),
    "no emitter": (replaced("room/scene.xml", EMITTER, ""), [], ["room", "no emitter"]),
    "a name that steers terminals": (nothing, ["--data.root=\x1b[2J" + "x" * 9999], ["x...x", "\\x1b[2J"]),
    "unknown key of a part": (
        written("tiny.yaml", "model: {sampling: {position: 3}}"), [], ["tiny.yaml", "model.sampling.position"]),
    "patch larger than the photographs": (nothing, ["--data.patch_size=64"], ["--data.patch_size", "64"]),
    "checkpoint of another scene": (
        replaced("room/meshes/floor.ply", "-1 0 1 0 0", "-1.5 0 1 0 0"), GO_ON, ["--ckpt_path", "room"]),
    "checkpoint of other field sizes": (
        nothing, [*GO_ON, "--model.albedo.width=16"], ["--ckpt_path", "field sizes"]),
    "checkpoint of a field with other inputs": (  # as many numbers, so that weights have the same shapes
        nothing, [*GO_ON, "--model.radiance.inputs=[normal, direction, albedo]"],
        ["--ckpt_path: ", "['direction', 'normal', 'albedo']", "['normal', 'direction', 'albedo']"]),
    "mitsuba missing": ("mitsuba", [], ["scene.xml", "pip install 'neurad[mitsuba]'"]),
    "open3d missing": ("open3d", ["--model.tracer=open3d"], ["open3d", "pip install 'neurad[open3d]'"]),
    "folder and built-in scene": (nothing, ["--data.scene=kitchen"], ["(data.root)", "(data.scene)"]),
    "scene without photographs": (nothing, ["--data.root=null", "--data.scene=cube"], ["train_000", "photograph"]),
    "test without a photograph": (removed("room/images/test_1.exr"), ["test"], ["test_1.exr"]),
    "render onto photographs": (
        nothing, ["render", "--root", "room", "--out", "room"], ["--out", "train_0.exr", "--overwrite"]),
    "render by no tracer": (nothing, ["render", "--root", "room", "--out", "new", "--tracer", "optix"], ["optix"]),
}  # fmt: skip
"""Words follow those of a fit, or begin with another verb. What is wrong with a scene itself has its own table, in
tests/formats/test_refused_folders.py.
"""


@pytest.mark.parametrize("case", BAD)
def test_bad_input(fitted_room, monkeypatch, capfd, recwarn, case):
    spoil, args, said = BAD[case]
    if isinstance(spoil, str):  # a package that is not installed
        monkeypatch.setitem(sys.modules, spoil, None)
    else:
        spoil(fitted_room)
    gc.collect()  # what earlier tests left open is no warning of this one
    recwarn.clear()
    before = tree(fitted_room)
    sentence = fails(capfd, *(() if args and args[0].isalpha() else FIT), *args)
    assert len(sentence) < 500
    for word in said:
        assert word in sentence
    assert tree(fitted_room) == before
    assert not [
        str(w.message)
        for w in recwarn.list
        if not issubclass(w.category, DeprecationWarning | PendingDeprecationWarning)
    ]


def test_the_program_itself_says_no_more_than_the_sentence(fitted_room):
    """One of them as a process of its own: exit code and all of stderr, imports included."""
    photograph(np.nan)(fitted_room / "room")
    before = tree(fitted_room)
    code = "from neurad.cli import main; main()"
    done = subprocess.run([sys.executable, "-c", code, *FIT], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith("neurad: error: ")
    assert done.stderr.count("\n") == 1
    assert "train_1.exr" in done.stderr
    assert tree(fitted_room) == before


def test_the_scene_itself_is_good(fitted_room):
    """What all cases above start from trains, also in continuation."""
    before = tree(fitted_room)
    main([*FIT, "--ckpt_path=last", "--trainer.max_steps=4"])
    changed = {name for name, found in tree(fitted_room).items() if before.get(name) != found}
    assert {f"lightning_logs/version_0/{name}" for name in ("metrics.csv", "checkpoints/last.ckpt")} < changed
    assert all(name.startswith("lightning_logs/version_0") for name in changed)


def test_a_fit_names_what_it_replaces_and_what_is_known_has_to_be_rendered(fitted_room, capfd):
    as_floor('<bsdf type="phong" id="shelf"/>')(fitted_room / "room")
    main(FIT)
    assert "neurad: to be recovered as principled: shelf (phong)\n" in capfd.readouterr().err
    for words in (["render", "--root", "room", "--out", "out", "--spp", "2"], [*FIT, "--model.materials=known"]):
        assert "bsdf shelf of shape floor has type phong" in fails(capfd, *words)


# ---- words on a command line, of all verbs


FILES = {
    "key": "modle: {seed: 1}",
    "value": "model: {objective: {epsilon: fast}}",
    "torn": "a: [1",
    "list": "[1, 2]",
    "open": "data:\n  root: ???",
    "loop": "base: loop.yaml",
    "dangling": "model: {objective: {epsilon: '${nowhere}'}}",
}
"""Configs that are none, by name."""
TINY = "fit --config tiny.yaml --trainer.max_steps=2"
REFUSED = [
    ("train", "train"),
    ("fti", "did you mean fit"),
    ("fit --config methods/ourz.yaml", "did you mean methods/ours.yaml?"),
    ("fit --config tinny.yaml", "did you mean tiny.yaml?"),
    (f"{TINY} --data.scene=cornel", "did you mean cornell?"),
    ("fit --config", "--config"),
    ("fit --config nothing.yaml", "nothing.yaml"),
    ("fit --config key.yaml", "key.yaml: modle.seed"),
    ("fit --config value.yaml", "value.yaml: model.objective.epsilon"),
    ("fit --config torn.yaml", "torn.yaml"),
    ("fit --config list.yaml", "list.yaml"),
    ("fit --config open.yaml", "--data.root"),
    ("fit --config loop.yaml", "loop.yaml"),
    ("fit --config dangling.yaml", "nowhere"),
    (f"fit --model.objective.epsilon {10**400}", "--model.objective.epsilon: the number is too large"),
    ("fit --config tiny.yaml --trainer.max_steps=1 '--trainer.default_root_dir=~nosuchuser'",
     "--trainer.default_root_dir ~nosuchuser"),
    ("fit --ckpt_path '~nosuchuser/last.ckpt'", "--ckpt_path ~nosuchuser/last.ckpt"),
    ("fit --model.objective.epsilon fast", "--model.objective.epsilon: fast is not a number"),
    ("fit --model.albedo.kind sparse", "--model.albedo.kind: sparse is none of hash, dense"),
    ("fit --model.radiance.inputs '[5]'", "--model.radiance.inputs: 5 is not a text"),
    ("fit --model.sampling 5", "--model.sampling: it is a group of settings"),
    ("fit --config tiny.yaml --model.method.k x", "--model.method.init_args.k: x is not a whole number"),
    ("fit --trainer.logger CSVLogger", "--trainer.logger: CSVLogger is neither true nor false"),
    ("fit --trainer.callbacks '[TrainingBudget]'", "--trainer.callbacks"),
    ("fit --trainer.max_steps=1 --trainer.accelerator=tpu", "trainer: "),
    ('fit --model.method \'{"class_path": "neurad.integrators.prb.PRB", "dict_kwargs": {"z": 1}}\'',
     "neurad.integrators.prb.PRB has no setting z"),
    ("fit", "--trainer.max_steps"),
    ("fit --trainer.max_steps 2 --trainer.accelerator warp", "warp"),
    ("fit --trainer.callbacks '[os.system]'", "os.system"),
    ("fit --trainer.max_steps=2 --data.root nowhere", "nowhere"),
    ("fit --ckpt_path last", "--ckpt_path last"),
    ("fit --ckpt_path version_3", "--ckpt_path version_3: there is no such run folder or checkpoint"),
    ("fit --ckpt_path torn.yaml", "torn.yaml"),
    (f"{TINY} --seed_everything=-1", "--seed_everything: -1 is out of range"),
    (f"{TINY} --model.seed=3", "model.seed is not a known setting"),
    (f"{TINY} --trainer.limit_train_batches=0.5", "trainer.limit_train_batches is not a known setting"),
    (f"{TINY} --trainer.devices=-3", "--trainer.devices: -3"),
    (f"{TINY} --trainer.devices=1000", "--trainer.devices: 1000 processes"),
    (f"{TINY} --trainer.devices=[0,-1]", "trainer.devices[1]: -1 is out of range"),
    (f"{TINY} --model.optimization.matmul=low", "model.optimization.matmul"),
    (f"{TINY} --model.albedo.grid.coarsest=16", "coarsest"),
    (f"{TINY} --model.albedo.kind=dense --model.albedo.grid.finest=null",
     "model.albedo.grid.finest: null is out of range for a dense grid, give at most 1023"),
    (f"{TINY} --model.radiance.kind=dense --model.radiance.grid.finest=1024",
     "model.radiance.grid.finest: 1024 is out of range for a dense grid, give at most 1023"),
    (f"{TINY} '--model.radiance.inputs=[colour]'", "colour"),
    (f"{TINY} --model.method=neurad.integrators.nothing.Nothing", "Nothing"),
    (f"{TINY} --model.tracer=optix", "optix"),
    (f"{TINY} --trainer.precision=16-mixed", "trainer.precision is not a known setting"),
    ("fit --config=cornell.yaml --config=methods/path.yaml --trainer.max_steps=1 --model.method.init_args.max_depth=1",
     "max_depth 1 shows emitters only"),
    ("fit --config cornell.yaml --model.sampling.sppp 3",
     "command line: model.sampling.sppp is not a known setting, did you mean model.sampling.spp?"),
    ("fit --config cornell.yaml --config methods/ours.yaml --model.method.init_args.bounces=2",
     "--model.method: neurad.integrators.radiometric.Radiometric has no setting bounces"),
    ("fit --config tiny.yaml --trainer.max_time 240",
     "--trainer.max_time: 240 has no unit, a time is written 60s, 4m, 1h30m or DD:HH:MM:SS"),
    ("fit --config tiny.yaml --trainer.max_time soon", "--trainer.max_time: soon is not a time, such as 60s"),
    ("fit --config tiny.yaml --trainer.max_time 0.2s", "--trainer.max_time: 0.2s is too short"),
    (f"{TINY} --model.sampling.spp=1 --model.sampling.cached_spp=4", "model.sampling.spp"),
    (f"{TINY} --model.sampling.spp=4 --model.sampling.cached_spp=2", "model.sampling.cached_spp"),
    ("test --ckpt_path .", "it has no checkpoint"),
    ("render --scene cornell --out x --integrator pth", "did you mean path?"),
    ("render --sceen cornell --out x", "--scene"),
    ("render --scene cornell --views test --size 12 --out out --integrator direct --max-depth 3",
     "only paths have a depth"),
    ("data gltf a.glb --out room --blender blender", "--blender: it is for neurad data blender alone"),
    ("data colmpa x --out y", "did you mean colmap?"),
    ("compare --config tiny.yaml --bugdet 60s", "did you mean --budget?"),
    ("compare --config tiny.yaml --methods prb --budget soon", "soon is not a time, such as 60s"),
    ("check --scene furnace --out new", "no training photographs"),
    ("check", "a scene folder (data.root) or the name"),
    ("fit --config tiny.yaml --data.root=. --trainer.max_steps=2", "the config for a folder is scene.yaml"),
    ("render --out x", "no run in lightning_logs"),
    ("check --scene=cornell --model.lighting.emitters=some", "choose from"),
    ("view --port 70000", "70000 is out of range"),
    ("view --ckpt_path nowhere", "there is no such run folder"),
    ("stress --only stif", "did you mean stiff?"),
    ("bench steps", "did you mean step?"),
    ("bench cube --albedos 1.0 --out out", "--albedos"),
    ("bench cube --methods ours,nerf --out out", "--methods: nerf"),
    ("bench cube --spp 1.5 --out out", "--spp: '1.5' is not a whole number"),
    (f"bench cube --spp {'1' * 5000} --out out", "1... (5000 characters)' is not a whole number"),
    ("bench gradients --albedos 1.0", "--albedos"),
    ("bench peer --scene cornell --out out --budget 5 --peers mesh", "--peers"),
    ("bench peer --scene cornell --out out --budget 5 --set speed=3", "--set speed=3"),
    ("bench peer --scene cornell --out out --budget 5 --set grid.pixels=many", "grid.pixels=many"),
    ("bench peer --scene cornell --out out --budget 5 --config dense_nowhere.yaml", "dense_nowhere.yaml"),
    ("bench step --set nonsense", "not KEY=VALUE"),
    ("bench growth --device nowhere", "no such device"),
    ("bench growth --views x", "not numbers"),
]  # fmt: skip


@pytest.mark.parametrize(("line", "said"), REFUSED)
def test_words_that_cannot_be_meant(tiny, capfd, line, said):
    for name, text in FILES.items():
        Path(f"{name}.yaml").write_text(text)
    assert said in fails(capfd, *shlex.split(line))


# ---- the command line as a user meets it: help, and mistakes in what is typed


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
