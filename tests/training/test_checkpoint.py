"""Which scene a checkpoint may be used for."""

import pytest

from neurad.core.errors import InputError
from neurad.scene.builtin import build
from neurad.training.checkpoint import check_scene, scene_state


def test_a_run_of_the_kitchen_before_the_present_one_is_told_its_name():
    kitchen, patterns = build("kitchen"), build("patterns")
    old = {**scene_state(patterns), "scene": "kitchen"}
    with pytest.raises(InputError, match=r"is now called patterns: --data.scene patterns"):
        check_scene(old, kitchen, "--ckpt_path", same_light=False)
    check_scene(old, patterns, "--ckpt_path", same_light=True)
    with pytest.raises(InputError, match=r"is of scene kitchen, not of cornell as given$"):
        check_scene(old, build("cornell"), "--ckpt_path", same_light=False)
