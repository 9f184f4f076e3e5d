"""Checkpoints that lack what only takes noise away."""

from types import SimpleNamespace

import torch

from neurad.training.checkpoint import fitting

SCENE = SimpleNamespace(name="room", fingerprint="f")


def checkpoint(**weights):
    return {"neurad": {"fingerprint": "f", "scene": "room"}, "state_dict": weights}


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
