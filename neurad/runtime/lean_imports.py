"""Imports Lightning without what it imports and a fit does not use: a quarter of the time to the first step.

Lightning asks whether models are those of ``torch.compile``, and imports all of that for the question; its torchmetrics
imports matplotlib for plots of metrics and scipy's signal processing for those of sound.
"""

import sys
from typing import Any

_UNUSED = (
    "torch._dynamo",
    "scipy.signal",
    "matplotlib",
    "matplotlib.axes",
    "matplotlib.pyplot",
)


class _Kind(type):
    def __getattr__(cls, name: str) -> Any:
        if name.startswith("__"):  # what the import system asks of modules
            raise AttributeError(name)
        return cls


class _Nothing(metaclass=_Kind):
    """Stands for a module and all that it has: a class of no objects, and decorators that leave a function as it is."""

    def __new__(cls, *given: Any, **_: Any) -> Any:
        return given[0] if len(given) == 1 and callable(given[0]) else cls


def import_lightning() -> None:
    """Import it with stand-ins for those modules, where nobody has imported them yet. The next one to import them gets
    the modules themselves.
    """
    import scipy  # noqa: F401  (what the stand-ins are parts of)
    import torch  # noqa: F401

    modules: dict[str, Any] = sys.modules
    stand_ins = [name for name in _UNUSED if name not in modules]
    modules.update(dict.fromkeys(stand_ins, _Nothing))
    try:
        import lightning.pytorch  # noqa: F401
    finally:
        for name in stand_ins:
            if modules.get(name) is _Nothing:
                del modules[name]
