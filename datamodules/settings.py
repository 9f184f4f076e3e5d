"""Settings of the photographs, as they stand in YAML. Their help imports neither torch nor Lightning."""

from __future__ import annotations  # the parser then takes a number for a number, whatever its range

from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from neurad.core.errors import InputError
from neurad.core.ranges import INTERNAL, Ceiling, Count, CountOrZero, Range, checked
from neurad.formats.cameras import HOLD_OUT
from neurad.formats.reader import Reader


@dataclass(frozen=True)
class DataSettings:
    """Photographs, and the pixels that a step sees of them."""

    root: str | None = None
    """A scene folder: ``scene.xml``, ``transforms_train.json``, photographs."""
    scene: str | None = None
    """Name of a built-in scene instead, such as ``kitchen``."""
    reader: Reader | None = None
    """A class of your own that reads the folder, see docs/extending.md; null: the files that neurad knows."""
    patches: Annotated[int, Range(1, 1 << 24)] | Literal["auto"] = 256
    """Patches in a batch, of all views in turn; ``auto`` for as many pixels as suit the device: 512 a thread of a CPU,
    1024 at most, and 4096 on a GPU."""
    patch_size: Annotated[int, Range(1, 1 << 14)] = 1
    """Side of a patch in pixels; 1 draws single pixels."""
    seed: int = field(default=0, metadata=INTERNAL)
    """Of the draws of pixels: the run's ``seed_everything``."""
    resident: Count | None = None
    """Training photographs in memory at once; the others are read from disk as their turn comes. None keeps all in
    memory."""
    hold_out: CountOrZero = HOLD_OUT
    """Every so many-th photograph is held out where the camera file does not say which; 0 for none."""
    validation_pixels: Annotated[float, Range(0.0, 0.5)] = 0.0
    """Fraction of the training pixels that are never drawn, 16384 of them at most: their loss says how much of each
    level of the fields is noise of the photographs. Patches draw all."""
    response: str | None = None
    """Curve of photographs of codes (PNG, JPEG, TIFF): ``linear``, ``srgb``, ``gamma=G``, ``fit``, or a file of codes
    and linear values; None takes sRGB's and says so. EXR and Radiance pictures are linear."""
    ceiling: Ceiling | None = None
    """Value from which on photographs are clipped, of codes a fraction of the largest; there only a render below it is
    wrong. None takes what the format says."""
    exposure: Literal["known", "fit"] = "known"
    """``known`` divides by the exposures of the camera file or of EXIF; ``fit`` begins there and recovers a gain for
    each photograph, whose logarithms' mean stays what it is."""
    white_balance: Literal["known", "fit"] = "known"
    """``fit`` recovers a gain for each colour of each photograph."""
    poses: Literal["fixed", "refine"] = "fixed"
    """``refine`` moves the cameras of training photographs before the fit, until photographs agree with each other and
    with the edges of the mesh; held-out cameras stay as they are given."""
    mesh: Literal["fixed", "refine"] = "fixed"
    """``refine`` flattens walls, floors and tables of a scan, within the errors that it has; modelled meshes stay."""
    hints: str | list[dict[str, Any]] | None = None
    """A file of what you say of places in the room, see docs/hints.md: what shines, what is one material, what is to be
    left out; or its entries, as they stand in the config of a run."""
    lamps_true: str | None = None
    """Table of the lamps' true radiance (mesh, r, g, b), for scores of lamps that are recovered."""

    def __post_init__(self) -> None:
        if self.hold_out == 1:
            raise InputError("--data.hold_out: 1 would hold out every photograph and leave none to learn from")
        checked(self)
