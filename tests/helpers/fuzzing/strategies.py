"""Strategies of hypothesis that draw recipes."""

from random import Random

from hypothesis import strategies as st

from helpers.fuzzing.spoil_commands import COMMANDS
from helpers.fuzzing.spoil_runs import RUNS
from helpers.fuzzing.spoil_scenes import GROUPS


def _recipes(kind, names, most=4, **more):
    """Recipes with one to ``most`` mutations, mostly one: what is wrong in two ways is refused for the first.

    The mutations' numbers come from one that is drawn: drawn apart, they would be small or alike too often.
    """

    def numbered(drawn, variant, seed):
        numbers = Random(seed)
        mutations = [[name, *(numbers.randrange(1 << 16) for _ in range(3))] for name in drawn]
        return {"kind": kind, "variant": variant, "mutations": mutations, **more}

    counts = st.sampled_from([count for count in (1, 1, 1, 1, 2, 2, 3, 4) if count <= most])
    drawn = counts.flatmap(lambda count: st.lists(names, min_size=count, max_size=count))
    return st.builds(numbered, drawn, st.integers(0, 99), st.integers(0, (1 << 64) - 1))


def scenes():
    """Scene folders with mutations of all kinds, some more often than others."""
    groups = st.sampled_from((0, 0, 0, 1, 1, 2, 3, 3, 3))
    return _recipes("scene", groups.flatmap(lambda group: st.sampled_from(GROUPS[group])))


def plausible_scenes():
    """Scene folders where a value is odd: a good part of them can be fitted."""
    often = ["xml_number"] * 5 + ["xml_insert"] * 2 + ["exr_pixels"] * 2 + ["four"] * 2
    once = ["xml_change", "xml_move", "xml_move", "bitmap_kind", "json_change", "token"]
    return _recipes("scene", st.sampled_from(often + once), most=2)


def settings(runs=False):
    """Configs and command lines; those of a fit that ``runs`` ask for no more than it can give."""
    return _recipes("settings", st.sampled_from(COMMANDS), runs=runs)


def verbs(runs=False):
    return _recipes("verb", st.sampled_from(("option", "option", "option", "drop", "change", "word")), runs=runs)


def checkpoints():
    return _recipes("checkpoint", st.sampled_from(RUNS))


def fits():
    """Whole commands: half of them fits of scene folders."""
    kinds = {"scene": plausible_scenes(), "settings": settings(True), "verb": verbs(True)}
    kinds["checkpoint"] = checkpoints()
    return st.sampled_from(["scene"] * 5 + ["settings"] * 2 + ["checkpoint"] * 2 + ["verb"]).flatmap(kinds.get)
