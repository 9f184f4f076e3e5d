"""Which diffuse lobe recovered surfaces have: Burley's, as in Mitsuba, or Lambert's, as in Cycles, and which coat.

A rough surface of the one is bright at grazing angles, of the other its coat is, but less, and a fit that has the wrong
one bends roughness and albedo until they explain the difference. All pixels of a room tell of it. So in the first part
of a fit the lobe is a mixture of both, whose parts are found by gradient descent together with roughness and albedo;
then the one of which there is more is taken.
"""

import torch

from neurad.assembly.build import Assembly
from neurad.assembly.fitted_materials import FittedMaterials

DECIDED, DECIDED_AGAIN = 0.4, 0.75
"""Fraction of a fit after which one of the two is taken, where metals are looked for not before these are decided; and
after which that is done where some were found, and the search began anew: metals that are taken for dielectrics have no
diffuse lobe of either kind.
"""


@torch.no_grad()
def keep_in_range(materials: FittedMaterials) -> None:
    """Keep the part of Lambert's lobe between none and all."""
    assert materials.lambert is not None
    materials.lambert.clamp_(0.0, 1.0)


def _begin(assembly: Assembly) -> float:
    return float(assembly.scene.diffuse == "lambert")


@torch.no_grad()
def look_again(assembly: Assembly) -> None:
    """Forget what was found, and look from where the fit began to."""
    materials = assembly.materials
    if isinstance(materials, FittedMaterials) and materials.lambert is not None:
        begin = _begin(assembly)
        materials.lambert.fill_(begin)
        materials.keep_lobe(False)
        assembly.world.set_lambert(begin)


@torch.no_grad()
def decide(assembly: Assembly) -> str | None:
    """Take one of the two, for good; a sentence if that is not the files'."""
    materials = assembly.materials
    assert isinstance(materials, FittedMaterials)
    assert materials.lambert is not None
    lambert = float(materials.lambert) > 0.5
    assembly.world.set_lambert(float(lambert))
    materials.keep_lobe()
    if lambert == _begin(assembly):
        return None
    lobe = "Lambertian, as in Cycles and glTF" if lambert else "Burley's, as in Mitsuba"
    return f"by the photographs, what lies under the surfaces' coat is {lobe}"
