"""Names that no two things share, also where a number that would be given is taken."""

import pytest

from neurad.core.names import make_unique


@pytest.mark.parametrize(
    ("names", "joint", "capitals", "made"),
    [
        (["a", "a", "a"], "-", True, ["a", "a-2", "a-3"]),
        (["a", "a-2", "a", "a"], "-", True, ["a", "a-2", "a-3", "a-4"]),
        (["a", "a", "a-2"], "-", True, ["a", "a-2", "a-2-2"]),
        (["Wand", "wand"], "_", True, ["Wand", "wand"]),
        (["Wand", "wand", "WAND"], "_", False, ["Wand", "wand_2", "WAND_3"]),
    ],
)
def test_no_two_names_are_equal(names, joint, capitals, made):
    taken: set[str] = set()
    assert [make_unique(name, taken, joint, capitals) for name in names] == made
    assert len(taken) == len(names)
