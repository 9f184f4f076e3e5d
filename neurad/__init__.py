"""neurad: inverse rendering under global illumination with a neural radiometric prior.

The Python door is :func:`load`: it reads what a fit has recovered.
"""

from __future__ import annotations

TYPE_CHECKING = False
if TYPE_CHECKING:
    import os
    from collections.abc import Sequence

    import torch

    from neurad.runs.load import LoadedRun

__version__ = "0.1.0"


def load(
    run: str | os.PathLike[str] | None = None,
    root: str | os.PathLike[str] | None = None,
    device: str | torch.device = "cpu",
    trust: str | Sequence[str] = (),
) -> LoadedRun:
    """Read what a fit has recovered: scene, world, materials and radiance field, without a Trainer.

    >>> run = neurad.load("lightning_logs/version_3")
    >>> points = run.surface(run.scene.test[0])
    >>> run.map("albedo", points), run.map("roughness", points), run.render(run.scene.test[0], spp=16)

    Args:
        run: a run folder such as ``lightning_logs/version_3``, or a checkpoint in one; None or 'last' takes the newest
            run in ``lightning_logs``.
        root: where the scene's folder is now, if it has moved since the fit; or a folder of the same geometry with
            other light, in which pictures are path traced.
        device: where to put everything.
        trust: names of your own modules that the run's method may be in: they are imported, which runs them, from the
            working folder or what is installed. Nothing in a run folder can trust a module.

    Raises:
        InputError: there is no such run, its checkpoint cannot be read or does not fit, its scene is missing or has
            changed, or its method is in a module that is not trusted.
    """
    from neurad.runs.load import load_run  # torch and all else that a run needs

    return load_run(run, root, device, trust=trust)
