"""A short fit of the Cornell box on several processes; each writes what it has learned. For test_gradient_sync.py."""

import atexit
import os
import sys
import warnings
from dataclasses import replace
from unittest.mock import patch

import lightning.pytorch as pl
import torch
import torch.distributed as dist

from datamodules.scene_data import SceneData
from datamodules.settings import DataSettings
from neurad.assembly.model_settings import ModelSettings
from neurad.assembly.settings import Optimization, Sampling
from neurad.core.records import SurfaceInteraction
from neurad.core.rng import Stream
from neurad.fields.settings import FieldConfig, GridConfig, RadianceConfig, RoughnessConfig
from neurad.scene import builtin
from neurad.training.inverse import InverseRenderer
from neurad.training.loopback import LoopbackDDP
from neurad.training.objective import StepTerms

STEPS = 8


class Joined:
    """The step of one process that does the work of two: pixels and random numbers of both, mean of their losses."""

    def __init__(self, step, data, seed):
        self.step, self.data, self.seed = step, data, seed

    def __call__(self, batch, stream):
        materials, field, seen = {}, {}, []
        for rank in range(2):
            own = self.step(self.data.batch(batch.iteration, rank), Stream(self.seed, batch.iteration, rank, 1))
            materials |= {f"{name}{rank}": (0.5 * w, loss) for name, (w, loss) in own.materials.items()}
            field |= {f"{name}{rank}": (0.5 * w, loss) for name, (w, loss) in own.field.items()}
            seen.append(own.guide_samples)
        return StepTerms(materials, field, None if seen[0] is None else both(*seen))


def both(a, b):
    """What two processes saw."""
    return SurfaceInteraction.cat(a[0], b[0]), *(torch.cat(x) for x in zip(a[1:], b[1:], strict=True))


class Join(pl.Callback):
    """Has one process do the work of two, and keeps what training starts from."""

    def on_train_start(self, trainer, module):
        self.start = {name: value.clone() for name, value in module.state_dict().items()}
        module.step.objective = Joined(module.step.objective, trainer.datamodule, module.settings.seed)


def fit(devices, seed=0, kind="hash", joined=False):
    """Fitted module after ``STEPS`` iterations; ``kind`` 'glossy' takes the patterned kitchen, which has a guide."""
    warnings.filterwarnings("ignore")
    grid = GridConfig(levels=3, coarsest=4, finest=16, log2_size=10)
    sizes = {"grid": grid, "width": 16, "kind": "dense" if kind == "dense" else "hash"}
    settings = ModelSettings(
        FieldConfig(**sizes), RoughnessConfig(**sizes), RadianceConfig(**sizes, hidden_layers=1),
        sampling=Sampling(spp=2, samples_per_vertex=1, cached_spp=2),
        optimization=Optimization(schedule="constant", average=0.5), seed=seed,
    )  # fmt: skip
    module = InverseRenderer(settings)
    trainer = pl.Trainer(
        accelerator="cpu", devices=devices, strategy=LoopbackDDP() if devices > 1 else "auto",
        max_steps=STEPS, max_epochs=-1, logger=False, enable_checkpointing=False,
        enable_progress_bar=False, enable_model_summary=False,
        num_sanity_val_steps=0, limit_val_batches=0, callbacks=[Join()] if joined else [],
    )  # fmt: skip
    scene = builtin.build("patterns" if kind == "glossy" else "cornell")
    few = replace(scene, train=scene.train[:3], test=scene.test[:1])
    with patch.dict(builtin._BUILDERS, {scene.name: lambda: few}):
        trainer.fit(module, SceneData(DataSettings(scene=scene.name, patches=128, seed=seed)))
    return module, trainer


if __name__ == "__main__":
    # Runs after what registers later; in one piece, since the other process writes to the same pipe.
    atexit.register(lambda: os.write(1, b"in a group at exit: %r\n" % dist.is_initialized()))
    module, trainer = fit(2, kind=sys.argv[2])
    state = {name: value for name, value in module.state_dict().items()}
    torch.save(
        {"state": state, "rays": module.rays, "samples": module.samples, "iteration": module.iteration},
        f"{sys.argv[1]}/{trainer.global_rank}.pt",
    )
