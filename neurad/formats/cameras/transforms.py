"""Camera files as they are written: NeRF's and Blender's keys, with nerfstudio's for lenses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy.typing as npt

from neurad.core.records import View
from neurad.formats.cameras.intrinsics import described
from neurad.scene.origin import ZERO, moved_views


def transforms(views: Sequence[View], origin: npt.ArrayLike = ZERO, maps: Sequence[str] = ()) -> dict[str, Any]:
    """The camera file of views: what all their cameras share stands at the top, what they do not in each frame.

    Args:
        views: relative to ``origin``.
        origin: ``Scene.origin``, which is added.
        maps: surface parameters of which there are maps beside the photographs.
    """
    views = moved_views(views, origin)
    lenses = [described(view.camera) for view in views]
    shared = lenses[0] if all(lens == lenses[0] for lens in lenses) else {}
    return {
        **shared,
        "frames": [
            {
                "file_path": f"images/{view.name}.exr",
                **{f"{name}_path": f"{name}/{view.name}.exr" for name in maps},
                **({} if shared else lens),
                **({} if view.development.exposure is None else {"exposure": view.development.exposure}),
                "transform_matrix": [[float(x) for x in row] for row in view.camera.to_world],
            }
            for view, lens in zip(views, lenses, strict=True)
        ],
    }
