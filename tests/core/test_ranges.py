"""Ranges in the types of settings, and the one function that checks them."""

import argparse
import math
from dataclasses import dataclass, field, replace
from typing import Annotated

import pytest

from neurad.core.errors import InputError
from neurad.core.ranges import (
    Count,
    Finite,
    Fraction,
    NonNegative,
    OpenFraction,
    Positive,
    PositiveFraction,
    Range,
    checked,
    option,
    range_of,
    violations,
)


@pytest.mark.parametrize(
    ("hint", "inside", "outside"),
    [
        (Positive, [1e-30, 5], [0.0, -1.0]),
        (NonNegative, [0, 1e30], [-1e-30]),
        (Fraction, [0.0, 1], [-0.1, 1.1]),
        (PositiveFraction, [1e-9, 1.0], [0.0, 1.1]),
        (OpenFraction, [0.5], [0.0, 1.0]),
        (Count, [1, 2**31 - 1], [0, -1, 2**31, 10**400]),
        (Finite, [-1e30, 0], []),
    ],
)
def test_what_lies_in_a_range(hint, inside, outside):
    allowed = range_of(hint)
    assert all(value in allowed for value in inside)
    assert not any(value in allowed for value in [*outside, math.nan, math.inf, -math.inf, True, "1", None])


@dataclass(frozen=True)
class Inner:
    rate: Positive = 0.1
    depth: Annotated[int, Range(1, 9)] | None = None
    weights: tuple[Positive, ...] = ()

    def __post_init__(self):
        checked(self)


@dataclass(frozen=True)
class Outer:
    inner: Inner = field(default_factory=Inner)


class Plain:
    def __init__(self, steps: Count = 1, scene: str = "") -> None:
        self.steps = steps
        self.scene_name = scene
        checked(self)

    @property
    def scene(self):
        raise AssertionError("a check must not read a scene")


@pytest.mark.parametrize("wrong", [{"rate": 0.0}, {"rate": math.nan}, {"depth": 10}, {"weights": (1.0, -1.0)}])
def test_objects_made_in_python_are_checked(wrong):
    with pytest.raises(InputError, match=rf"Inner\.{next(iter(wrong))}.*it must be (above|at least)"):
        Inner(**wrong)
    with pytest.raises(InputError):
        replace(Inner(), **wrong)
    Inner(depth=None)


def test_a_class_without_fields_is_checked_by_its_arguments():
    Plain(3)
    with pytest.raises(InputError, match=r"Plain\.steps: 0 is out of range, it must be at least 1"):
        Plain(0)


def test_a_parsed_tree_names_the_setting_with_its_dots():
    tree = {"inner": {"rate": -1.0, "depth": 3, "weights": [0.5, math.inf]}}
    found = [key for key, _ in violations(tree, Outer, "model")]
    assert found == ["model.inner.rate", "model.inner.weights[1]"]
    method = {"class_path": "neurad.integrators.path.PathTracing", "init_args": {"rr_prob": 2.0, "max_depth": None}}
    __import__("neurad.integrators.path")
    assert [key for key, _ in violations(method, object, "model.method")] == ["model.method.init_args.rr_prob"]


def test_options_of_verbs_have_ranges_too(capsys):
    parser = argparse.ArgumentParser()
    parser.add_argument("--spp", type=option(Count))
    assert parser.parse_args(["--spp", "4"]).spp == 4
    for text in ("0", "nan", "1.5", "1" * 5000):
        with pytest.raises(SystemExit):
            parser.parse_args(["--spp", text])
        said = capsys.readouterr().err.splitlines()[-1]
        assert "--spp" in said
        assert len(said) < 200
