"""What the pages name exists: files, functions, settings, commands, and the equations in docstrings."""

import argparse
import ast
import functools
import importlib
import itertools
import re
import shlex
from pathlib import Path

import pytest
from helpers.pages import DOCS, PAGES, REPOSITORY, pages, without_blocks
from helpers.tiny_fit import leaves, printed_config

from benchmarks.bench.verb import BENCHMARKS
from neurad.cli import LIGHTNING_VERBS, OWN_VERBS, split_settings
from neurad.runs.configs import load_config, split_arguments
from neurad.runs.trust import split_trust

SOURCES = [path for top in ("neurad", "datamodules") for path in sorted((REPOSITORY / top).rglob("*.py"))]
FILES = re.compile(r".*\.(csv|png|exr|usdc|npz|xml|json|html|md|ckpt|ipynb|py|toml)")
KEYS = re.compile(r"(?<![\w./])(?:--)?((?:model|data|trainer|evaluation|checkpoint)\.[a-z_]+(?:\.[a-z_]+)*)(?![\w/*(])")
FOLDERS = ("neurad/", "datamodules/", "configs/", "tests/", "docs/", ".ci/")


def in_backticks(text):
    """Every piece of inline code, with its line breaks as spaces."""
    return [" ".join(piece.split()) for piece in re.findall(r"(?<!`)`([^`]+)`(?!`)", without_blocks(text))]


def expanded(name):
    """``a/{b,c}.yaml`` as its names."""
    parts = [piece.split(",") for piece in re.split(r"[{}]", name)]
    return ["".join(choice) for choice in itertools.product(*parts)]


# ---- names


def bound(node):
    targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
    return {getattr(node, "name", None), *(getattr(target, "id", None) for target in targets)} - {None}


@functools.cache
def defined():
    """Names by the last part of their module's, those of classes as ``Class.name``."""
    modules = {}
    for path in SOURCES:
        found = modules.setdefault(path.stem, set())
        for node in ast.parse(path.read_text()).body:
            found |= bound(node)
            if isinstance(node, ast.ClassDef):
                found |= {f"{node.name}.{name}" for child in node.body for name in bound(child)}
    return modules


@pages
def test_every_name_exists(page):
    """Files and ``module.function`` in inline code."""
    modules, bad = defined(), []
    for piece in in_backticks(page.read_text()):
        word = piece.split(" ")[0].rstrip(",")
        if word.startswith(FOLDERS):
            names = [name for name in expanded(word.removesuffix(":")) if "mine." not in name]
            bad += [name for name in names if not list(REPOSITORY.glob(name.rstrip("/")))]
        elif word.endswith(".yaml") and "mine" not in word and word != "config.yaml":
            bad += [name for name in expanded(word) if not (REPOSITORY / "configs" / name).is_file()]
        elif re.fullmatch(r"[a-z_]\w*(\.\w+)+", word) and not FILES.fullmatch(word):
            module, _, name = word.partition(".")
            if module == "run":  # what neurad.load returns, on the Python page
                module, name = "load", f"LoadedRun.{name}"
            known = modules.get(module) if module != "neurad" else set(dir(importlib.import_module("neurad")))
            if known is not None and name not in known and not KEYS.fullmatch(word):
                bad.append(word)
    assert bad == []


# ---- equations


def equations():
    """Number of an equation and the code that is it, from the table of the method page."""
    table = re.findall(
        r"^\| Eq\. (\d+) \|.*?\| `(neurad/[\w/]+\.py)` \| (.*?) \|$", (DOCS / "method.md").read_text(), re.M
    )
    return [(int(n), file, name) for n, file, names in table for name in re.findall(r"`([\w.]+)`", names)]


def test_the_table_has_every_equation():
    assert [n for n, *_ in equations()] == sorted([*range(1, 15), 10])


@pytest.mark.parametrize(("number", "file", "name"), equations())
def test_docstrings_name_their_equations(number, file, name):
    module, _, rest = name.partition(".")
    assert Path(file).stem == module
    node = ast.parse((REPOSITORY / file).read_text())
    for part in rest.split("."):
        node = next(child for child in node.body if getattr(child, "name", None) == part)
    # ``Eq. 1``, ``Eq. 3, 10``, ``Eq. 12 and 13``
    said = re.findall(r"Eq\. (\d+(?:(?:, | and )\d+)*)", " ".join((ast.get_docstring(node) or "").split()))
    assert str(number) in re.findall(r"\d+", " ".join(said))


# ---- settings and commands


@pytest.fixture(scope="module")
def settings():
    """Every setting of ``fit`` and every group of them, by its full name."""
    names = [key.split(".") for key in leaves(printed_config("--config", "cornell.yaml"))]
    return {".".join(parts[: k + 1]) for parts in names for k in range(len(parts))}


@pages
def test_every_setting_exists(page, settings):
    assert [key for key in KEYS.findall(page.read_text()) if key not in settings] == []


def commands(text):
    """Every ``neurad ...`` in code blocks and inline code, as words."""
    blocks = [line for line in re.sub(r"\\\n +", " ", text).splitlines() if re.match(r" {4}\S", line)]
    found = []
    for line in [*blocks, *in_backticks(text)]:
        for part in line.split("&&"):
            words = shlex.split(part.strip(), comments=True) if part.strip().startswith("neurad ") else []
            if words and tuple(words[1:]) not in found:
                found.append(tuple(words[1:]))
    return found


COMMANDS = list(dict.fromkeys(words for page in PAGES for words in commands(page.read_text())))
OWN = [words for words in COMMANDS if words[0] in OWN_VERBS and len(words) > 2]


def of_lightning():
    """Config files and settings of every command that Lightning's parser reads."""
    for verb, *rest in COMMANDS:
        if verb in LIGHTNING_VERBS:
            names, values, left = split_arguments(split_trust(rest)[1])
            assert all(word.startswith("--") for word in left), rest
            yield names, values


def test_every_verb_and_config_exists():
    verbs = {words[0] for words in COMMANDS}
    assert verbs >= {*LIGHTNING_VERBS, *OWN_VERBS}
    assert verbs <= {*LIGHTNING_VERBS, *OWN_VERBS, "-h"}
    assert {words[1] for words in COMMANDS if words[0] == "bench" and len(words) > 1} <= set(BENCHMARKS)

    for names, _ in of_lightning():
        for name in names:
            assert "mine" in name or load_config(name)


def test_every_value_parses(settings):
    """All settings given on all commands, each value once."""
    given = {}
    for _, values in of_lightning():
        for key, value in values.items():
            given.setdefault(key, set()).add(value)
    assert set(given) <= settings
    given.pop("ckpt_path", None)
    rounds = itertools.zip_longest(*([(key, value) for value in sorted(values)] for key, values in given.items()))
    for pairs in rounds:
        printed_config("--config", "kitchen.yaml", *(f"--{pair[0]}={pair[1]}" for pair in pairs if pair))


@pytest.mark.parametrize("words", OWN, ids=" ".join)
def test_every_own_command_parses(words, settings):
    verb, *rest = words
    load, _ = OWN_VERBS[verb]
    parser = argparse.ArgumentParser(exit_on_error=False)
    load().add_arguments(parser)
    passed_on = []
    if parser.get_default("settings") is not None:
        rest, passed_on = split_settings(rest)
    options = parser.parse_args(rest)
    assert {word.partition("=")[0].removeprefix("--") for word in passed_on} <= settings
    if verb == "compare":
        for name in (options.methods or "").split(","):
            assert not name or load_config(f"{name}.yaml" if "/" in name else f"methods/{name}.yaml")
