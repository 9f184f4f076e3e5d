"""Grids, networks and fields give the same values and gradients on every device."""

import copy

import pytest
import torch
from helpers.devices import close, dense, on_devices

from neurad.core.parameters import ALBEDO, ROUGHNESS
from neurad.core.records import SurfaceInteraction
from neurad.fields.dense_grid import DenseGrid
from neurad.fields.hash_grid import HashGrid
from neurad.fields.material import MaterialField
from neurad.fields.mlp import MLP, products
from neurad.fields.radiance import RadianceField
from neurad.fields.settings import FieldConfig, GridConfig, RadianceConfig, RoughnessConfig
from neurad.fields.unit_cube import UnitCube

N = 3000
BOUNDS = torch.tensor([[-1.0, 0.0, -3.0], [1.0, 0.5, 5.0]])
GRID = GridConfig(levels=4, coarsest=2, finest=64, log2_size=10)
LAYERS = {
    "hash grid": (lambda k: HashGrid(6, 2, 64, log2_size=10, use_kernels=k), 3),
    "one hashed level of the paper's finest": (lambda k: HashGrid(1, 65536, 65536, log2_size=12, use_kernels=k), 3),
    "dense grid": (lambda k: DenseGrid(17, 3), 3),
    "network": (lambda k: MLP(12, 3, 32, 2, use_kernels=k), 12),
    "network of one hidden layer": (lambda k: MLP(11, 3, 32, 1, use_kernels=k), 11),
    "network of odd sizes": (lambda k: MLP(37, 6, 70, 2, use_kernels=k), 37),
    "linear map": (lambda k: MLP(5, 4, 8, 0, use_kernels=k), 5),
}


@on_devices
@pytest.mark.parametrize("name", LAYERS)
def test_layers_give_values_and_gradients_of_the_reference(device, name):
    make, inputs = LAYERS[name]
    reference = make(False)
    with torch.no_grad():
        for p in reference.parameters():
            p.normal_(std=0.3)
    layer = make(True)
    layer.load_state_dict(reference.state_dict())
    layer.to(device)
    x = torch.rand(N, inputs, requires_grad=inputs > 3)  # positions have no gradient
    there = x.detach().to(device).requires_grad_(x.requires_grad)
    expected = reference(x)
    cotangent = torch.randn_like(expected)
    expected.backward(cotangent)
    found = layer(there)
    assert found.device.type == device
    found.backward(cotangent.to(device))
    close(found, expected)
    inputs_too = [(there, x)] * x.requires_grad
    for p, q in [*zip(layer.parameters(), reference.parameters(), strict=True), *inputs_too]:
        close(dense(p.grad), dense(q.grad), rtol=1e-3, atol=1e-4 * float(dense(q.grad).abs().max()))
    with torch.no_grad():
        close(layer(there), expected)
        assert layer(there[:0]).shape == (0, expected.shape[1])


@on_devices
def test_positions_land_in_the_same_place_of_the_cube(device):
    cube = UnitCube(BOUNDS)
    p = BOUNDS[0] + (BOUNDS[1] - BOUNDS[0]) * (1.4 * torch.rand(N, 3) - 0.2)  # some beyond the bounds
    expected = cube.reference(p)
    close(cube.to(device)(p.to(device)), expected, rtol=0, atol=1e-6)
    assert float(expected.amin()) == 0.0


def interactions(n):
    unit = [torch.nn.functional.normalize(torch.randn(n, 3), dim=-1) for _ in range(3)]
    p = BOUNDS[0] + (BOUNDS[1] - BOUNDS[0]) * torch.rand(n, 3)
    index = torch.zeros(n, dtype=torch.int64)
    return SurfaceInteraction(p, *unit, torch.rand(n, 2), torch.rand(n, 2), index, index == 0)


FIELDS = {
    "albedo": lambda: MaterialField(ALBEDO, FieldConfig(GRID, 16), BOUNDS),
    "albedo on a dense grid": lambda: MaterialField(ALBEDO, FieldConfig(GRID, kind="dense"), BOUNDS),
    "roughness": lambda: MaterialField(ROUGHNESS, RoughnessConfig(GRID, 16), BOUNDS),
    "roughness that reads albedo": lambda: MaterialField(
        ROUGHNESS, RoughnessConfig(GRID, 16, reads_albedo=True), BOUNDS
    ),
    "radiance": lambda: RadianceField(RadianceConfig(GRID, 16), BOUNDS, 3.0),
    "radiance of a diffuse scene": lambda: RadianceField(RadianceConfig(GRID, 16, inputs=("faceforward",)), BOUNDS),
    "radiance on a dense grid": lambda: RadianceField(RadianceConfig(GRID, kind="dense"), BOUNDS),
}


@on_devices
@pytest.mark.parametrize("name", FIELDS)
def test_fields_give_the_same_on_every_device(device, name):
    field = FIELDS[name]()
    with torch.no_grad():
        for p in field.parameters():
            p.normal_(std=0.3)
    there = copy.deepcopy(field).to(device)
    si, albedo = interactions(N), torch.rand(N, 3)

    def read(module, where):
        lanes = si.to(where)
        more = () if isinstance(module, MaterialField) and module.parameter == ALBEDO else (albedo.to(where),)
        return module(lanes, *more)

    expected, found = read(field, "cpu"), read(there, device)
    assert found.device.type == device
    cotangent = torch.randn_like(expected)
    expected.backward(cotangent)
    found.backward(cotangent.to(device))
    close(found, expected)
    for p, q in zip(there.parameters(), field.parameters(), strict=True):
        close(dense(p.grad), dense(q.grad), rtol=1e-3, atol=1e-4 * float(dense(q.grad).abs().max()))
    assert {k: v.shape for k, v in there.state_dict().items()} == {k: v.shape for k, v in field.state_dict().items()}


@on_devices
@pytest.mark.parametrize(("precision", "error"), [("highest", 1e-5), ("high", 3e-3)])
def test_rounded_products_stay_close(device, precision, error):
    network = MLP(12, 3, 64, 2)
    x = torch.rand(N, 12)
    with torch.no_grad():
        expected = network.reference(x)
        before = torch.get_float32_matmul_precision()
        with products(precision):
            found = network.to(device)(x.to(device)).cpu()
    assert torch.get_float32_matmul_precision() == before
    assert (found - expected).norm() < error * expected.norm()
