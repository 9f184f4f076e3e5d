"""One optimizer for each thing that is not known."""

from __future__ import annotations

from neurad.assembly.build import FittedMaterials
from neurad.assembly.settings import Optimization
from neurad.core.protocols import Materials
from neurad.emitters.fitted import FittedEnvironment
from neurad.fields.material import RoughnessField
from neurad.fields.mlp import MLP
from neurad.fields.radiance import RadianceField
from neurad.optim.pyramid_adam import PyramidAdam
from neurad.optim.sparse_row_adam import SparseRowAdam


def make_optimizers(
    materials: Materials,
    environment: FittedEnvironment | None,
    radiance: RadianceField | None,
    rates: Optimization,
    detail_decay: float = 0.3,
) -> dict[str, SparseRowAdam | PyramidAdam]:
    """Optimizers by the names of their learning rates, in the order in which checkpoints keep them.

    Args:
        materials: fields to fit, or known ones, which need none; a Lambertian scene has no roughness to find.
        environment: map to recover; None where the light is known.
        radiance: field of the methods that read one.
        rates: learning rates.
        detail_decay: pull of the environment's detail, as in ``Lighting``.
    """
    made: dict[str, SparseRowAdam | PyramidAdam] = {}
    if isinstance(materials, FittedMaterials):
        made["albedo"] = SparseRowAdam(materials.albedo.parameters(), lr=rates.albedo)  # type: ignore[attr-defined]
        if materials.roughness is not None:
            made["roughness"] = _for_roughness(materials.roughness, rates)
    if environment is not None:
        made["environment"] = PyramidAdam(
            [environment.values], environment.width, lr=rates.environment, detail_decay=detail_decay
        )
    if radiance is not None:
        made["radiance"] = SparseRowAdam(radiance.parameters(), lr=rates.radiance)
    return made


def _for_roughness(field: RoughnessField, rates: Optimization) -> SparseRowAdam:
    """Adam whose weight decay is that of the table in front of the network; a grid alone has none, as it would be drawn
    to one half.
    """
    decays = rates.roughness_decay > 0.0 and isinstance(field.mlp, MLP)
    table = field.grid.parameters() if decays else ()
    return SparseRowAdam(field.parameters(), lr=rates.roughness, weight_decay={p: rates.roughness_decay for p in table})
