"""Odd options of the verbs that are neurad's own."""

import argparse
from pathlib import Path

from helpers.fuzzing.odd import NAMES, NUMBERS, WORDS, pick

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
VALUES = tuple(x.replace("\0", "").replace("\ud800", "\udcff") for x in (*NUMBERS, *WORDS, *NAMES, *LISTS))


def options_of(verb: str) -> list[argparse.Action]:
    """The options of a verb's parser."""
    from neurad import cli

    name, _, benchmark = verb.partition(" ")
    parser = argparse.ArgumentParser(prog="neurad")
    cli.OWN_VERBS[name][0]().add_arguments(parser)
    if benchmark:
        parser = next(a for a in parser._actions if isinstance(a, argparse._SubParsersAction)).choices[benchmark]
    return [action for action in parser._actions if action.option_strings and action.dest != "help"]


def arguments(recipe: dict, folder: Path) -> list[str]:
    """The command line of a recipe."""
    verb = "render" if recipe["runs"] else pick(sorted(GOOD), recipe["variant"])
    words = f"{verb} {GOOD[verb]}".split()
    for name, i, j, k in recipe["mutations"]:
        options = options_of(verb)
        value = pick(VALUES, j)
        while recipe["runs"] and _costs(value):
            j += 1
            value = pick(VALUES, j)
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


def _costs(text: str) -> bool:
    try:
        return float(text) > 300
    except ValueError:
        return False
