"""``neurad fit --help``: every setting, with its words, at once."""

import inspect
import math
import subprocess
import sys
import time
import types
from argparse import ArgumentTypeError
from collections.abc import Mapping
from typing import Union, get_args, get_origin

import pytest
from helpers.fuzzing.spoil_commands import options_of
from helpers.tiny_fit import fails, write_tiny_config

from benchmarks.bench.verb import BENCHMARKS
from datamodules.settings import DataSettings
from neurad.cli import OWN_VERBS, main
from neurad.core.ranges import Range, hints, is_settings, range_of
from neurad.integrators.debiased import Debiased
from neurad.integrators.path import PathTracing
from neurad.integrators.radiometric import Radiometric
from neurad.runs import lightning
from neurad.runs.settings_help import CALLBACKS, GROUPS, LARGE, METHOD, all_settings, method_settings
from neurad.runs.trainer_settings import complaints

ALL = {"data": DataSettings, **GROUPS}


@pytest.fixture(scope="module")
def parsed(tmp_path_factory):
    """The parser of ``neurad fit`` by keys, the types of its groups, and settings that it has read."""
    found = {}
    parse = lightning.NeuradCLI.parse_arguments

    def keep(settings, groups):
        found.update(settings=settings, groups=groups)
        raise KeyboardInterrupt

    def keep_parser(self, parser, args):
        found["actions"] = {action.dest: action for action in self._subcommand_parsers["fit"]._actions}
        parse(self, parser, args)

    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("parsed"))
        write_tiny_config()
        patch.setattr(lightning, "complaints", keep)
        patch.setattr(lightning.NeuradCLI, "parse_arguments", keep_parser)
        with pytest.raises(SystemExit):
            main(["fit", "--config", "tiny.yaml", "--trainer.max_steps=2"])
    return found


@pytest.fixture(scope="module")
def settings():
    return {setting.key: setting for group in all_settings(ALL).values() for setting in group}


def test_every_setting_of_the_parser_is_there_with_words(parsed, settings):
    keys = {key for key in parsed["actions"] if key.partition(".")[0] in ALL and "." in key and key[-5:] != ".help"}
    groups = {key for key in keys if any(other.startswith(f"{key}.") for other in keys)}
    assert settings.keys() == keys - groups
    assert len(settings) > 80
    assert [key for key, setting in settings.items() if len(setting.words) < 10] == []  # 100 % have words


def test_defaults_are_those_of_the_parser(parsed, settings):
    for key, setting in settings.items():
        if key not in (METHOD, CALLBACKS):
            default = parsed["actions"][key].default
            default = list(default) if isinstance(default, tuple) else default
            assert setting.default is inspect.Parameter.empty or setting.default == default, key


def test_methods_are_those_that_are_shipped():
    from neurad.runs.configs import shipped_methods

    found = method_settings()
    named = {path for heading in found for path in heading.removeprefix(f"{METHOD}.class_path ").split(" or ")}
    assert named == {method["class_path"] for method in shipped_methods().values()}
    for heading, settings in found.items():
        assert all(len(setting.words) > 10 for setting in settings), heading
    (of_prb,) = (settings for heading, settings in found.items() if "PRB" in heading)
    (depth,) = (setting for setting in of_prb if setting.key == f"{METHOD}.init_args.max_depth")
    assert (depth.default, depth.kind) == (16, "whole number, at least 1 or null")


@pytest.mark.parametrize("verb", ["fit", "predict"])
def test_help_puts_first_what_is_given_most_often(capsys, verb):
    main([verb, "--config", "kitchen.yaml", "--help"])
    out = capsys.readouterr().out
    given = "--config NAME.yaml ..." if verb == "fit" else "[--ckpt_path RUN]"
    assert out.startswith(f"usage: neurad {verb} {given} [--KEY VALUE ...]\n")
    assert out.index("--ckpt_path RUN\n") < out.index("--trainer.max_time") < out.index("--data.patches")
    assert out.index("--data.patches") < out.index("--model.sampling.spp")
    assert max(map(len, out.splitlines())) <= 120


def test_help_imports_nothing_heavy_and_answers_at_once():
    heavy = "{'torch', 'lightning', 'numpy'} & set(sys.modules)"
    code = f"import sys; from neurad.cli import main; main([]); main(['-h']); main(['fit', '--help'])\nprint({heavy})"
    begin = time.monotonic()
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert time.monotonic() - begin < 20  # 0.3 s on an idle machine; the bound is for a crowded one
    assert done.stdout.endswith("set()\n")
    assert done.stdout.count("usage: neurad VERB") == 2
    assert all(f"  {verb} " in done.stdout for verb in ("fit", "validate", "test", "predict", "render"))


def test_help_of_some_settings(capfd):
    main(["fit", "--help", "guide"])
    out = capfd.readouterr().out
    assert "--model.sampling.guide 16" in out
    assert "at least 0 and at most 32" in out
    assert "--model.sampling.spp" not in out
    main(["fit", "--help", "method"])
    assert f"--{METHOD}.init_args.first_prob 0.5    (number, above 0 and at most 1)" in capfd.readouterr().out
    main(["fit", "--help", "first_prob"])
    assert f"--{METHOD}.init_args.first_prob" in capfd.readouterr().out
    assert "did you mean spp" in fails(capfd, "fit", "--help", "sppp")


# ---- every number among the settings has a range, whoever reads it: the parser, the help and the pages


def is_number(hint):
    """Whether a value of this type may be a number."""
    if get_origin(hint) in (Union, types.UnionType, list, tuple):
        return any(is_number(part) for part in get_args(hint))
    return hint in (int, float)


def ranges(settings, prefix=""):
    """Ranges of all numbers of groups of settings and of those inside them, by name."""
    found = {}
    for name, hint in settings.items():
        if isinstance(hint, Mapping) or is_settings(hint):
            found |= ranges(hint if isinstance(hint, Mapping) else hints(hint), f"{prefix}{name}.")
        elif allowed := range_of(hint):
            found[prefix + name] = allowed
    return found


def test_every_number_of_the_parser_has_a_range_and_the_help_has_it(parsed, settings):
    known = ranges(parsed["groups"])
    actions = {key for key, action in parsed["actions"].items() if is_number(getattr(action, "_typehint", None))}
    assert len(actions) > 50
    anywhere = {"model.lighting.lamps"}  # coordinates
    assert actions - known.keys() - anywhere == {"seed_everything"}
    assert known.keys() <= actions
    for key, allowed in known.items():
        assert str(Range(allowed.low, above=allowed.above)) in settings[key].kind
        if allowed.high < LARGE - 1:
            assert str(allowed) in settings[key].kind
    for method in (Radiometric, PathTracing, Debiased):
        assert not any(is_number(hint) for hint in hints(method).values())  # a number without a range


def test_every_number_among_the_options_of_other_verbs_has_a_range():
    verbs = [*(OWN_VERBS.keys() - {"bench"}), *(f"bench {name}" for name in BENCHMARKS)]
    numbers = {(verb, *a.option_strings): a.type for verb in verbs for a in options_of(verb) if a.type in (int, float)}
    assert numbers == {}
    (spp,) = (action.type for action in options_of("bench cube") if action.dest == "spp")
    assert spp("2") == 2
    with pytest.raises(ArgumentTypeError, match="1 is out of range, it must be at least 2"):
        spp("1")


def outside(allowed):
    yield from (math.nan, math.inf, -math.inf)
    if allowed.low > -math.inf:
        yield allowed.low if allowed.above else allowed.low - 1
    if allowed.high < math.inf:
        yield allowed.high if allowed.below else allowed.high * 2 + 1


def changed(tree, key, value):
    first, _, rest = key.partition(".")
    return {**tree, first: changed(tree[first], rest, value) if rest else value}


def test_each_refuses_what_lies_outside(parsed):
    settings, groups = parsed["settings"], parsed["groups"]
    assert list(complaints(settings, groups)) == []
    for key, allowed in ranges(groups).items():
        for value in outside(allowed):
            ((name, text),) = complaints(changed(settings, key, value), groups)
            assert name == key
            assert str(value) in text
            assert f"it must be {allowed}" in text
