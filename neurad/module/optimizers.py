"""One optimizer for each thing that is not known."""

from __future__ import annotations

from neurad.core.protocols import Materials
from neurad.emitters.fitted import FittedEnvironment
from neurad.fields.adam import FieldAdam
from neurad.fields.map_adam import MapAdam
from neurad.fields.material import RoughnessField
from neurad.fields.mlp import MLP
from neurad.fields.radiance import RadianceField
from neurad.module.assemble import FittedMaterials
from neurad.module.config import Optimization


def make_optimizers(
    materials: Materials,
    environment: FittedEnvironment | None,
    radiance: RadianceField | None,
    rates: Optimization,
    smooth: float = 0.3,
) -> dict[str, FieldAdam | MapAdam]:
    """Optimizers by the names of their learning rates, in the order in which checkpoints keep them.

    Args:
        materials: fields to fit, or known ones, which need none; a Lambertian scene has no roughness to find.
        environment: map to recover; None where the light is known.
        radiance: field of the methods that read one.
        rates: learning rates.
        smooth: pull of the environment's detail, as in ``Lighting``.
    """
    made: dict[str, FieldAdam | MapAdam] = {}
    if isinstance(materials, FittedMaterials):
        made["albedo"] = FieldAdam(materials.albedo.parameters(), lr=rates.albedo)  # type: ignore[attr-defined]
        if materials.roughness is not None:
            made["roughness"] = _for_roughness(materials.roughness, rates)
    if environment is not None:
        made["environment"] = MapAdam([environment.values], environment.width, lr=rates.environment, smooth=smooth)
    if radiance is not None:
        made["radiance"] = FieldAdam(radiance.parameters(), lr=rates.radiance)
    return made


def _for_roughness(field: RoughnessField, rates: Optimization) -> FieldAdam:
    """Adam whose weight decay is that of the table in front of the network; a grid alone has none, as it would be drawn
    to one half.
    """
    decays = rates.roughness_decay > 0.0 and isinstance(field.mlp, MLP)
    table = field.grid.parameters() if decays else ()
    return FieldAdam(field.parameters(), lr=rates.roughness, weight_decay={p: rates.roughness_decay for p in table})
