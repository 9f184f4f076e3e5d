"""One optimizer for each thing that is not known."""

from collections.abc import Sequence

from torch import Tensor, nn

from neurad.assembly.build import Assembly
from neurad.assembly.fitted_materials import FittedMaterials
from neurad.assembly.settings import Optimization
from neurad.core.parameters import ROUGHNESS
from neurad.fields.dense_grid import DenseGrid
from neurad.fields.hash_grid import HashGrid
from neurad.fields.material import MaterialField
from neurad.fields.mlp import MLP
from neurad.optim.pyramid_adam import PyramidAdam
from neurad.optim.sparse_row_adam import SparseRowAdam

RATES = {"exposure": 3e-4, "response": 1e-2}
"""Learning rates that are no settings: of the logarithms of the photographs' gains, and of the weights of their
response curve."""

DETAIL_DECAY = 0.003
"""Decay of the detail of an environment's map, so that what no photograph shows stays smooth; more of it draws the
ground up to the sky."""


def make_optimizers(assembly: Assembly) -> dict[str, SparseRowAdam | PyramidAdam]:
    """Optimizers by the names of their learning rates, in the order in which checkpoints keep them.

    Known materials need none, a diffuse scene has no roughness to find, and a known environment, known lamps and a
    method without a radiance field have none either.
    """
    rates, environment, radiance = assembly.settings.optimization, assembly.environment, assembly.radiance
    materials = assembly.materials
    made: dict[str, SparseRowAdam | PyramidAdam] = {}
    if isinstance(materials, FittedMaterials):
        for name, field in materials.recovered.items():
            others = [materials.lambert] if name == ROUGHNESS.name and materials.lambert is not None else []
            made[name] = _of_field(field, getattr(rates, name), rates, others)
    if environment is not None:
        made["environment"] = PyramidAdam(
            [environment.values], environment.width, lr=rates.light, detail_decay=DETAIL_DECAY
        )
    lamps = [] if environment is None else [environment.sun.values]
    if assembly.lamps is not None and assembly.lamps.values.requires_grad:
        lamps.append(assembly.lamps.values)
    if assembly.world.flash is not None and assembly.world.flash.gain.requires_grad:
        lamps.append(assembly.world.flash.gain)
    if lamps:
        made["lamps"] = SparseRowAdam(lamps, lr=rates.light)
    if radiance is not None:
        made["radiance"] = SparseRowAdam(radiance.parameters(), lr=rates.radiance, tables=_tables(radiance))
    development = assembly.development
    if development is not None and development.values is not None:
        made["exposure"] = SparseRowAdam([development.values], lr=RATES["exposure"])
    if development is not None and development.bend is not None:
        made["response"] = SparseRowAdam([development.bend], lr=RATES["response"])
    return made


def _of_field(field: MaterialField, rate: float, rates: Optimization, others: Sequence[Tensor]) -> SparseRowAdam:
    """Adam of a field, and of ``others`` with it; of the roughness its weight decay is that of the table in front of
    the network; a grid alone has none, as it would be drawn to one half.
    """
    parameters = [*(p for p in field.parameters() if p.requires_grad), *others]
    decay: dict[Tensor, float] = {}
    if field.parameter == ROUGHNESS and isinstance(field.mlp, MLP) and rates.roughness_decay > 0.0:
        decay = dict.fromkeys(field.grid.parameters(), rates.roughness_decay)
    return SparseRowAdam(parameters, lr=rate, weight_decay=decay, tables=_tables(field))


def _tables(field: nn.Module) -> list[nn.Parameter]:
    return [module.table for module in field.modules() if isinstance(module, HashGrid | DenseGrid)]
