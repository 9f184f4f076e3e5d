"""Every number among the settings has a range, whoever reads it: the parser, the help and the pages."""

import math
import types
from typing import Union, get_args, get_origin

import pytest
from helpers.tiny_fit import write_tiny_config

from datamodules.settings import DataSettings
from neurad.cli import main
from neurad.core.ranges import Range, all_ranges, hints
from neurad.integrators.debiased import Debiased
from neurad.integrators.path import PathTracing
from neurad.integrators.radiometric import Radiometric
from neurad.runs import lightning
from neurad.runs.settings_help import GROUPS, LARGE, all_settings
from neurad.runs.trainer_settings import RANGES, WITHOUT_EFFECT, complaints

METHODS = (Radiometric, PathTracing, Debiased)


@pytest.fixture(scope="module")
def parsed(tmp_path_factory):
    """The parser of ``neurad fit``, the types of its groups, and settings that it has read."""
    found = {}
    parse = lightning.NeuradCLI.parse_arguments

    def keep(settings, groups):
        found.update(settings=settings, groups=groups)
        raise KeyboardInterrupt

    def keep_parser(self, parser, args):
        found["actions"] = self._subcommand_parsers["fit"]._actions
        parse(self, parser, args)

    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("parsed"))
        write_tiny_config()
        patch.setattr(lightning, "complaints", keep)
        patch.setattr(lightning.NeuradCLI, "parse_arguments", keep_parser)
        with pytest.raises(SystemExit):
            main(["fit", "--config", "tiny.yaml", "--trainer.max_steps=2"])
    return found


def is_number(hint):
    """Whether a value of this type may be a number."""
    if get_origin(hint) in (Union, types.UnionType, list, tuple):
        return any(is_number(part) for part in get_args(hint))
    return hint in (int, float)


def ranges(groups):
    return {key: allowed for name, group in groups.items() for key, allowed in all_ranges(group, f"{name}.")}


def test_every_number_of_the_parser_has_a_range_and_the_help_has_it(parsed):
    known = ranges(parsed["groups"])
    actions = {action.dest: action for action in parsed["actions"] if is_number(getattr(action, "_typehint", None))}
    assert len(actions) > 60
    of_trainer = {f"trainer.{name}" for name in [*RANGES, *WITHOUT_EFFECT, "devices", "max_time"]}
    assert actions.keys() - known.keys() - of_trainer == {"seed_everything"}
    assert known.keys() <= actions.keys()
    groups = all_settings({"data": DataSettings, **GROUPS})
    helped = {setting.key: setting.kind for group in groups.values() for setting in group}
    for key, allowed in known.items():
        assert str(Range(allowed.low, above=allowed.above)) in helped[key]
        if allowed.high < LARGE - 1:
            assert str(allowed) in helped[key]
    for method in METHODS:
        assert not any(is_number(hint) for hint in hints(method).values())  # a number without a range


def outside(allowed):
    """Values that a range has not."""
    yield from (math.nan, math.inf, -math.inf)
    if allowed.low > -math.inf:
        yield allowed.low if allowed.above else allowed.low - 1
    if allowed.high < math.inf:
        yield allowed.high if allowed.below else allowed.high * 2 + 1


def changed(tree, key, value):
    """The settings with another value at a dotted name."""
    first, _, rest = key.partition(".")
    return {**tree, first: changed(tree[first], rest, value) if rest else value}


def test_each_refuses_what_lies_outside(parsed):
    settings, groups = parsed["settings"], parsed["groups"]
    assert list(complaints(settings, groups)) == []
    trainer = {
        f"trainer.{name}": next(extra for part in (hint, *get_args(hint)) for extra in get_args(part)
                                if isinstance(extra, Range))
        for name, hint in RANGES.items()
    }  # fmt: skip
    for key, allowed in {**ranges(groups), **trainer}.items():
        for value in outside(allowed):
            ((name, text),) = complaints(changed(settings, key, value), groups)
            assert name == key
            assert str(value) in text
            assert f"it must be {allowed}" in text


def test_settings_that_have_no_effect_say_what_has_one(parsed):
    for name in WITHOUT_EFFECT:
        ((key, text),) = complaints(changed(parsed["settings"], f"trainer.{name}", 7), parsed["groups"])
        assert key == f"trainer.{name}"
        assert text.startswith("it has no effect here, ")
