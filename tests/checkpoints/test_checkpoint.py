"""Which scene a checkpoint may be used for, and checkpoints that lack what only takes noise away."""

import pytest
import torch

from neurad.checkpoints.state import fitting, scene_state
from neurad.core.errors import InputError
from neurad.scene.builtin import build

SCENE = build("cornell")


def checkpoint(**weights):
    return {"neurad": scene_state(SCENE), "state_dict": weights}


def test_a_checkpoint_without_scores_of_pixels_continues_with_a_sentence(capsys):
    own = {"materials.w": torch.zeros(2), "focus.score": torch.ones(3), "focus.sums": torch.zeros(3, 2)}
    old = checkpoint(**{"materials.w": torch.full((2,), 5.0)})
    fitting(old, own, SCENE, None, continues=True)
    assert "model.sampling.focus" in capsys.readouterr().err
    assert torch.equal(old["state_dict"]["focus.score"], own["focus.score"])
    assert torch.equal(old["state_dict"]["materials.w"], torch.full((2,), 5.0))

    kept = checkpoint(**own | {"focus.score": torch.full((3,), 2.0)})
    fitting(kept, own, SCENE, None, continues=True)
    assert capsys.readouterr().err == ""
    assert torch.equal(kept["state_dict"]["focus.score"], torch.full((3,), 2.0))


def test_scores_of_pixels_are_dropped_where_none_are_wanted(capsys):
    own = {"materials.w": torch.zeros(2)}
    newer = checkpoint(**own, **{"focus.score": torch.ones(3)})
    fitting(newer, own, SCENE, None, continues=True)
    assert newer["state_dict"].keys() == own.keys()
    assert capsys.readouterr().err == ""


def test_a_fit_without_a_refinement_goes_on_to_one(capsys):
    own = {
        "materials.w": torch.zeros(2),
        "materials.fields.roughness.hierarchy.made": torch.zeros((), dtype=torch.int64),
    }
    old = checkpoint(**{"materials.w": torch.ones(2)})
    fitting(old, own, SCENE, None, continues=True)
    assert "model.roughness.structure" in capsys.readouterr().err
    assert old["state_dict"]["materials.fields.roughness.hierarchy.made"] == 0
    kept = checkpoint(**own | {"materials.fields.roughness.hierarchy.made": torch.ones((), dtype=torch.int64)})
    fitting(kept, own, SCENE, None)
    assert kept["state_dict"]["materials.fields.roughness.hierarchy.made"] == 1
    with pytest.raises(InputError, match="structure"):  # nothing that was found is dropped
        fitting(kept, {"materials.w": torch.zeros(2)}, SCENE, None)


@pytest.mark.parametrize("continues", [False, True])
def test_a_refinement_of_another_structure_is_not_dropped(continues, capsys):
    name = "materials.fields.roughness.hierarchy."
    own = {f"{name}made": torch.zeros((), dtype=torch.int64), f"{name}stds": torch.zeros(9)}
    old = checkpoint(**{f"{name}made": torch.ones((), dtype=torch.int64), f"{name}stds": torch.zeros(4)})
    with pytest.raises(InputError, match=r"^run r: the checkpoint has other field sizes than the config"):
        fitting(old, own, SCENE, None, "run r", continues)
    assert capsys.readouterr().err == ""
