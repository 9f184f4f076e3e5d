"""Error bars as a file of the run folder."""

import io
from pathlib import Path

import numpy as np

from neurad.core.errors import InputError
from neurad.core.parameters import BY_NAME, PARAMETERS
from neurad.evidence.error_bars import COLUMNS, ErrorBars, Nodes
from neurad.runtime.files import replacing
from neurad.runtime.reading import native, read_bytes

NAME = "error_bars.npz"
"""In the run folder: written by ``fit`` at its end and by ``test``."""
_SIZES = {
    "side": (),
    "index": (-1,),
    "values": (-1, COLUMNS),
    "cell": (),
    "spread": (3,),
    "iteration": (),
    "spreads": (len(PARAMETERS),),
    "determined": (len(PARAMETERS),),
}
"""What the file has; fractions and spreads by parameter, -1 of what has no error bars."""


def write_bars(bars: ErrorBars, path: Path) -> None:
    """Write error bars.

    Raises:
        InputError: the system refused.
    """
    with replacing(path) as part, part.open("wb") as file:
        np.savez_compressed(
            file, side=bars.nodes.side, index=bars.nodes.index, values=bars.nodes.values.astype(np.float32),
            cell=bars.cell, spread=bars.spread, iteration=bars.iteration,
            spreads=[bars.spreads.get(name, -1.0) for name in BY_NAME],
            determined=[bars.determined.get(name, -1.0) for name in BY_NAME],
        )  # fmt: skip


def read_bars(path: Path) -> ErrorBars:
    """Read what :func:`write_bars` wrote.

    Raises:
        InputError: there is no such file, or it is another one.
    """
    said = "it is no file of error bars; neurad test writes it anew"
    content = read_bytes(path, missing="there are no error bars of this run; neurad test writes them")
    with native(path, said), np.load(io.BytesIO(content), allow_pickle=False) as file:
        found = {name: file[name] for name in _SIZES}
    for name, size in _SIZES.items():
        shape, numbers = found[name].shape, np.asarray(found[name])
        fits = len(shape) == len(size) and all(want in (-1, have) for have, want in zip(shape, size, strict=True))
        if not fits or numbers.dtype.kind not in "fiu" or not np.isfinite(numbers).all():
            raise InputError(f"{path}: {said}")
    side = int(found["side"])
    index = found["index"].astype(np.int64)
    ordered = len(index) == len(found["values"]) and (np.diff(index) > 0).all()
    if side < 1 or not ordered:
        raise InputError(f"{path}: {said}")
    return ErrorBars(
        Nodes(side, index, found["values"].astype(np.float64)),
        float(found["cell"]),
        found["spread"].astype(np.float64),
        int(found["iteration"]),
        *(
            {name: float(value) for name, value in zip(BY_NAME, found[key], strict=True) if value >= 0.0}
            for key in ("spreads", "determined")
        ),
    )
