"""Training views with the true maps that benchmarks compare with."""

from dataclasses import replace

import numpy as np

from neurad.core.errors import InputError
from neurad.core.parameters import ROUGHNESS
from neurad.core.records import FloatArray
from neurad.metrics.held_out import HeldOut
from neurad.runs.load import LoadedRun


def training_truth(run: LoadedRun) -> tuple[FloatArray, list[FloatArray]]:
    """True materials of all training pixels [views, pixels, 4], and the photographs [h, w, 3].

    Raises:
        InputError: a view lacks one, has a mask or another size than the first.
    """
    scene, world = run.scene, run.world
    sizes = {(view.camera.width, view.camera.height) for view in scene.train}
    if len(sizes) > 1 or any(view.mask is not None for view in scene.train):
        raise InputError(f"scene {scene.name}: this takes training photographs of one size and without masks")
    reader = HeldOut(replace(scene, test=scene.train), world.geometry, world.tracer, 1)
    check_truth(reader, "training")
    maps, photographs = [], []
    for index in range(len(scene.train)):
        found = reader.truth(index)
        albedo = found["albedo_true"]
        roughness = found.get("roughness_true", np.ones_like(albedo[..., :1]))
        maps.append(np.concatenate((albedo, roughness), -1).reshape(-1, 4))
        photographs.append(found["photograph"])
    return np.stack(maps), photographs


def check_truth(reader: HeldOut, kind: str) -> None:
    """Check that every view has what is compared with.

    Args:
        reader: of the views.
        kind: of views, for the words.

    Raises:
        InputError: one has not.
    """
    if not reader.views:
        raise InputError(f"the scene has no {kind} views to compare with")
    names = {"photograph": "photograph", "albedo_true": "true albedo"}
    names |= {"roughness_true": "true roughness"} if ROUGHNESS in reader.scene.parameters else {}
    for index, view in enumerate(reader.views):
        for name, words in names.items():
            if name not in reader.truth(index):
                raise InputError(f"{kind} view {view.name}: it has no {words}, which is compared with here")
