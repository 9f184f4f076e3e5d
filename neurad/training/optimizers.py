"""One optimizer for each thing that is not known."""

from __future__ import annotations

from neurad.assembly.build import Assembly, FittedMaterials
from neurad.assembly.settings import Optimization
from neurad.fields.material import RoughnessField
from neurad.fields.mlp import MLP
from neurad.optim.pyramid_adam import PyramidAdam
from neurad.optim.sparse_row_adam import SparseRowAdam


def make_optimizers(assembly: Assembly) -> dict[str, SparseRowAdam | PyramidAdam]:
    """Optimizers by the names of their learning rates, in the order in which checkpoints keep them.

    Known materials need none, a diffuse scene has no roughness to find, and a known environment, known lamps and a
    method without a radiance field have none either.
    """
    rates, environment, radiance = assembly.settings.optimization, assembly.environment, assembly.radiance
    materials = assembly.materials
    made: dict[str, SparseRowAdam | PyramidAdam] = {}
    if isinstance(materials, FittedMaterials):
        made["albedo"] = SparseRowAdam(materials.albedo.parameters(), lr=rates.albedo)  # type: ignore[attr-defined]
        if materials.roughness is not None:
            made["roughness"] = _for_roughness(materials.roughness, rates)
    if environment is not None:
        made["environment"] = PyramidAdam(
            [environment.values],
            environment.width,
            lr=rates.environment,
            detail_decay=assembly.settings.lighting.detail_decay,
        )
    if assembly.lamps is not None and assembly.lamps.values.requires_grad:
        made["lamps"] = SparseRowAdam([assembly.lamps.values], lr=rates.lamps)
    if radiance is not None:
        made["radiance"] = SparseRowAdam(radiance.parameters(), lr=rates.radiance)
    development = assembly.development
    if development is not None and development.values is not None:
        made["exposure"] = SparseRowAdam([development.values], lr=rates.exposure)
    if development is not None and development.bend is not None:
        made["response"] = SparseRowAdam([development.bend], lr=rates.response)
    return made


def _for_roughness(field: RoughnessField, rates: Optimization) -> SparseRowAdam:
    """Adam whose weight decay is that of the table in front of the network; a grid alone has none, as it would be drawn
    to one half.
    """
    decays = rates.roughness_decay > 0.0 and isinstance(field.mlp, MLP)
    table = field.grid.parameters() if decays else ()
    return SparseRowAdam(
        [p for p in field.parameters() if p.requires_grad], lr=rates.roughness, betas=(0.9, rates.roughness_beta2),
        weight_decay={p: rates.roughness_decay for p in table},
    )  # fmt: skip
