"""Mutations of configs and command lines, of fits and of the verbs that are neurad's own."""

import argparse
import os
import re
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from helpers.fuzzing.odd import NAMES, NUMBERS, WORDS, pick
from helpers.fuzzing.spoil_bytes import GENERAL, write_files
from helpers.tiny_fit import TINY as SIZES

TINY = yaml.safe_dump({**SIZES, "base": "scene.yaml", "trainer": {**SIZES["trainer"], "max_steps": 2}})
"""A config of the smallest fit of a scene folder."""
CORNELL = {**SIZES, "base": "cornell.yaml", "trainer": {**SIZES["trainer"], "max_steps": 2}}
VALUES = (
    *NUMBERS, *WORDS, "[]", "{}", "[1]", "[[]]", "[a, b]", "{a: 1}", "{1: 2}", "[null]", ".nan", ".inf", "-.inf",
    "0b1", "0o17", "1:30", "00:00:01:00", "-00:00:00:01", "99:99:99:99", "2001-01-01", "yes", "off",
    "!!python/object/apply:os.mkdir [executed]", "!!binary aGk=", "!!set {a}", "!!str 1", "!x y", "&a [*a]",
    "*nothing", "${data}", "${nothing}", "${oc.env:HOME}", "${data.patches}", "${.seed}", "${", "???",
    "{class_path: os.mkdir, init_args: {path: executed}}", "{class_path: neurad.cli.main}", "{class_path: []}",
    "{class_path: neurad.integrators.path.PathTracing, init_args: {max_depth: -1}}",
    "{class_path: neurad.integrators.path.PathTracing, init_args: {nothing: 1}}",
    "{class_path: PathTracing, init_args: 3}",
    "{class_path: lightning.pytorch.loggers.CSVLogger, init_args: {save_dir: x}}", "{init_args: {max_depth: 2}}",
    "neurad.integrators.path.PathTracing", "[" * 300 + "]" * 300, "{a: " * 300 + "1" + "}" * 300, "[" * 20000, "- x",
    "a: b: c", "'", '"', "|\n x", ">", "# x", "%YAML 9.9", "---", "...", "<<: {a: 1}", "1e-400", "0.1", "1e-3",
    "-1e-3", "5", "16", "auto", "cpu", "gpu", "32", "bf16-mixed", "64-true", "embree", "warp", "kitchen",
    "fit", "known", "cosine", "last",
)  # fmt: skip
"""Text that may stand behind a key; also on the command line."""
EXTRA_KEYS = (
    "base", "model.method.class_path", "model.method.init_args", "model.method.init_args.max_depth",
    "model.method.init_args.rr_depth", "model.method.init_args.rr_prob", "model.method.init_args.control_variate",
    "model.method.init_args.nothing", "trainer.logger.init_args", "trainer.callbacks", "data.init_args",
    "model.nothing", "nothing", "model.albedo.grid.nothing", "model.radiance.inputs", "ckpt_path", "config", "", ".",
    "..", "model.", "a" * 300, "model.albedo.grid.levels.x", "model.objective.epsilon.x", "data", "model", "trainer",
    "evaluation",
)  # fmt: skip
BASES = (
    "5", "[1]", "null", "{}", "[]", "tiny.yaml", "[tiny.yaml]", "over.yaml", "nothing.yaml", "''", ".", "/",
    "[[scene.yaml]]", "[scene.yaml, scene.yaml]", "${data.scene}", "methods/prb.yaml", "/dev/zero", "~nobody/x",
    "2.5", "{a: b}",
)  # fmt: skip
ARGUMENTS = (
    ["--"], ["-"], ["--x"], ["--data"], ["--data.root"], ["--data.root", ""], ["--config"], ["--config", "over.yaml"],
    ["-c"], ["--config=", "x"], ["--config", "."], ["--config", "fifo"], ["--config", "\udcff"],
    ["--config", "a" * 300], ["x"], [""], ["@x"], ["--print_config=x"],
    ["--data.scene", "cornell", "--data.scene", "cube"], ["--data.root", "."], ["--model", "5"], ["--trainer+=5"],
    ["--trainer.callbacks+=x"], ["--trainer.callbacks+=neurad.callbacks.budget.TrainingBudget"],
    ["--ckpt_path", "last"], ["--ckpt_path", "tiny.yaml"], ["--ckpt_path", "."], ["--ckpt_path", "\udcff"],
    ["--seed_everything"], ["--seed_everything", "-1"], ["--=5"], ["--.=5"], ["--a.b.c.d=5"],
    ["--model.method", "neurad.integrators.path.PathTracing"], ["--model.method=PathTracing"],
    ["--model.method.max_depth=0"], ["--data", "{root: x}"], ["--data", "[1]"], ["--trainer", "null"], ["fit"],
    ["-h5"], ["--no_x"], ["--config", "{a: 1}"], ["--config", "cornell.yaml\n"],
    ["--trainer.callbacks.init_args.seconds", "5"], ["--config", "prb.yaml"],
)  # fmt: skip
SLURM = (
    "SLURM_NTASKS", "SLURM_JOB_ID", "SLURM_PROCID", "SLURM_NTASKS_PER_NODE", "SLURM_JOB_NAME", "WORLD_SIZE", "RANK",
    "LOCAL_RANK", "MASTER_PORT", "LSB_JOBID", "TORCHELASTIC_RUN_ID", "PL_TRAINER__MAX_STEPS", "NODE_RANK",
)  # fmt: skip
PLACEHOLDER = re.compile(r"@@raw (\d+)@@")
COSTLY = re.compile(r"^(trainer\.(devices|max_steps|max_time)|ckpt_path$)")
"""Settings that may honestly ask a fit for many processes or hours."""


@cache
def known_keys() -> tuple[str, ...]:
    from datamodules.scene_data import SceneData
    from neurad.runs.lightning import NeuradCLI, only_trusted_classes
    from neurad.training.inverse import InverseRenderer

    only_trusted_classes()
    known: list[str] = []
    with suppress(Exception):  # it names its settings and then finds that there is none of this name
        NeuradCLI("fit", None, InverseRenderer, SceneData, ["fit", "--nothing=1"], known)
    assert known
    return tuple(sorted({key for key in known if "." in key or key in EXTRA_KEYS}))


def _keys(recipe: dict) -> list[str]:
    keys = [*known_keys(), *EXTRA_KEYS]
    return [key for key in keys if not COSTLY.match(key)] if recipe["runs"] else keys


def _value(recipe: dict, number: int) -> int:
    """The number of a value; of one that a fit can run with, if it is to, and then of a plain number in most cases."""
    if recipe["runs"] and number % 3:
        number = number // 3 % len(NUMBERS)
    while recipe["runs"] and _costs(pick(VALUES, number)):
        number += 1
    return number % len(VALUES)


def _costs(text: str) -> bool:
    try:
        return 300 < float(text) < float("inf")
    except ValueError:
        return False


class _Command:
    """A config, one on top of it, and further arguments, on their way to being odd."""

    def __init__(self, recipe: dict) -> None:
        self.recipe = recipe
        self.tree: dict[Any, Any] = yaml.safe_load(yaml.safe_dump(CORNELL))
        self.over: dict[Any, Any] = {}
        self.arguments: list[str] = []
        self.bytes: list[list] = []

    def yaml_value(self, i: int, j: int, k: int) -> None:
        """An odd value in one of the configs."""
        tree = self.over if k % 3 == 0 else self.tree
        *above, last = pick(_keys(self.recipe), i).split(".")
        for name in above:
            below = tree.get(name)
            if not isinstance(below, dict):
                below = tree[name] = {}
            tree = below
        tree[last] = f"@@raw {_value(self.recipe, j)}@@"

    def yaml_base(self, i: int, j: int, k: int) -> None:
        (self.over if k % 2 else self.tree)["base"] = f"@@raw {i % len(BASES) + len(VALUES)}@@"

    def yaml_part(self, i: int, j: int, k: int) -> None:
        self.tree[pick(sorted(map(str, self.tree)), i)] = f"@@raw {_value(self.recipe, j)}@@"

    def argument(self, i: int, j: int, k: int) -> None:
        text = pick(VALUES, _value(self.recipe, j)).replace("\0", "").replace("\ud800", "\udcff")
        key = "--" + pick(_keys(self.recipe), i)
        self.arguments += [f"{key}={text}"] if k % 2 else [key, text]

    def word(self, i: int, j: int, k: int) -> None:
        if k % 7 == 0:
            name = pick(NAMES, j).replace("\0", "").replace("\ud800", "\udcff")
            self.arguments += [pick(("--config", "--data.root", "--ckpt_path"), i), name]
        else:
            self.arguments += pick(ARGUMENTS, i)

    def variable(self, i: int, j: int, k: int) -> None:
        """What a job scheduler leaves in the environment."""
        os.environ[pick(SLURM, i)] = pick(("1", "2", "", "x", "-1", "0"), j)

    def text(self, i: int, j: int, k: int) -> None:
        self.bytes.append([pick(("flip", "cut", "insert", "token", "line", "kind"), i), j, k, i])


COMMANDS = ("yaml_value", "yaml_value", "argument", "argument", "yaml_base", "yaml_part", "word", "variable", "text")
"""Mutations of settings, by name."""


def write_settings(recipe: dict, folder: Path) -> list[str]:
    """Write the configs of a recipe and return the command's arguments."""
    for name in SLURM:
        os.environ.pop(name, None)
    command = _Command(recipe)
    for name, i, j, k in recipe["mutations"]:
        getattr(command, name)(i, j, k)
    texts = VALUES + BASES
    files = {}
    for name, tree in (("tiny.yaml", command.tree), ("over.yaml", command.over)):
        text = PLACEHOLDER.sub(lambda found: pick(texts, int(found[1])), yaml.safe_dump(tree).replace("'", ""))
        files[name] = text.encode("utf-8", "surrogatepass")
    for name, i, j, k in command.bytes:
        GENERAL[name](files, i, j, k)
    write_files(files, folder)
    os.mkfifo(folder / "fifo")
    configs = ["--config", "tiny.yaml", *(["--config", "over.yaml"] if command.over else [])]
    last = ["--trainer.max_steps", "2", "--trainer.devices", "1"] if recipe["runs"] else []
    return ["fit", *configs, *command.arguments, *last]


# ---- neurad's own verbs

GOOD = {
    "render": "--scene cube --size 8 --spp 1 --map-spp 1 --views test --steps 2 --out out",
    "compare": "--config cornell.yaml --methods ours,prb --budget 5 --out out",
    "stress": "--quick --only field --out out",
    "bench step": "--config cornell.yaml",
    "bench growth": "--views= --out out",
    "bench cube": "--out out",
    "bench peer": "--scene cornell --budget 5",
    "bench gradients": "",
    "bench ceiling": "--config cornell.yaml",
}
"""Commands that work, by verb."""
LISTS = ("ours,ours", ",", ",,", "ours,", "1,2", "-1,0", "0,0", "1,x", "nan,1", "=", "a=b", "a=", "=b")
VERB_VALUES = tuple(x.replace("\0", "").replace("\ud800", "\udcff") for x in (*NUMBERS, *WORDS, *NAMES, *LISTS))


def options_of(verb: str) -> list[argparse.Action]:
    from neurad import cli

    name, _, benchmark = verb.partition(" ")
    parser = argparse.ArgumentParser(prog="neurad")
    cli.OWN_VERBS[name][0]().add_arguments(parser)
    if benchmark:
        parser = next(a for a in parser._actions if isinstance(a, argparse._SubParsersAction)).choices[benchmark]
    return [action for action in parser._actions if action.option_strings and action.dest != "help"]


def write_verb(recipe: dict, folder: Path) -> list[str]:
    verb = "render" if recipe["runs"] else pick(sorted(GOOD), recipe["variant"])
    words = f"{verb} {GOOD[verb]}".split()
    for name, i, j, k in recipe["mutations"]:
        options = options_of(verb)
        value = pick(VERB_VALUES, j)
        while recipe["runs"] and _costs(value):
            j += 1
            value = pick(VERB_VALUES, j)
        if name == "option" and options:
            option = pick(pick(options, i).option_strings, k)
            words += [f"{option}={value}"] if k % 2 else [option, value]
        elif name == "drop" and len(words) > 1:
            del words[1 + i % (len(words) - 1)]
        elif name == "change":
            words[i % len(words)] = value
        else:
            words.append(value)
    return words
