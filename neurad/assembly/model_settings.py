"""All settings under ``model``, with the method, whose class torch is imported for."""

from dataclasses import dataclass, field

from neurad.assembly.settings import RecoverySettings
from neurad.core.errors import InputError
from neurad.integrators.method import Method
from neurad.integrators.radiometric import Radiometric


@dataclass(frozen=True)
class ModelSettings(RecoverySettings):
    """All settings under ``model``."""

    method: Method = field(default_factory=Radiometric)
    """How reflected light and its derivative are estimated; the paper's: one bounce and then the radiance field."""

    def __post_init__(self) -> None:
        """Refuse settings that do not go together."""
        super().__post_init__()
        unknown = self.lighting.environment == "fit" or self.lighting.fits_lamps
        if self.materials == "known" and not unknown and not self.method.needs_field:
            raise InputError("model.materials: with known materials, known light and no radiance field nothing is left")
        if not self.method.reflects:
            raise InputError("model.method: max_depth 1 shows emitters only, no surface; direct light takes 2")
        lhs = self.objective.lhs > 0 and self.method.needs_field
        if (self.objective.estimator != "two_pass" or lhs) and self.sampling.spp < 2:
            raise InputError("model.sampling.spp: leave_one_out and lhs need at least 2 samples per pixel")
        if self.sampling.spp > self.sampling.cached_spp > 0:
            raise InputError("model.sampling.cached_spp: it must be at least model.sampling.spp, or 0")
