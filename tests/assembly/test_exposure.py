"""The warning about photographs that do not belong to the lights says what is true."""

import pytest

from benchmarks.stress.fit import photographs, resized
from benchmarks.stress.runs import fit
from neurad.assembly.exposure import sentence_if_far
from neurad.scene.builtin import build_cornell


def never():
    raise AssertionError("it takes a while and is not needed")


def test_only_what_is_so_is_said():
    assert sentence_if_far(1.0, never, never) == ""
    assert sentence_if_far(40.0, never, never) == ""
    assert "nearly black" in sentence_if_far(0.001, never, never)
    assert "materials cannot explain that" in sentence_if_far(100.0, lambda: 30.0, list)
    explained = sentence_if_far(104.0, lambda: 1.1, list)
    assert "cannot" not in explained
    assert "a mean albedo of about 0.99 in a closed room" in explained
    assert "lamp bulb faces away from the room" in sentence_if_far(104.0, never, lambda: ["bulb"])


@pytest.mark.parametrize(("factor", "said"), [(1.0, ""), (100.0, "materials cannot explain that")])
def test_photographs_in_other_units_are_noticed(factor, said):
    scene = resized(build_cornell(), 8)
    printed = fit(scene, photographs(scene, 8) * factor, 1)[1]
    assert ("times as bright" in printed) == bool(said)
    assert said in printed
