"""What grids span: not stray vertices, and of far triangles only what training rays meet."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.tiny_fit import checkpoint, fit, write_tiny_config
from helpers.tiny_scene import PLY, write_scene

from benchmarks.stress.fit import with_material
from neurad.assembly.build import assemble, build_world
from neurad.assembly.region import training_paths, training_region
from neurad.cli import main
from neurad.core.extent import OUTLYING
from neurad.core.reflection import PrincipledModel
from neurad.core.scene_records import Mesh
from neurad.emitters.lights import Lights
from neurad.fields.hierarchy import DETAILS
from neurad.fields.material import HIERARCHY_CELLS
from neurad.fields.settings import FieldConfig, GridConfig
from neurad.fields.unit_cube import SHELL, UnitCube
from neurad.runs.model_settings import model_settings
from neurad.scene.builtin import build_cornell
from neurad.scene.geometry import Geometry

CORNELL = build_cornell()


def with_triangle(scene, at, side=1.0):
    corners = np.array([[0, 0, 0], [side, 0, 0], [0, side, 0]], np.float32) + np.float32(at)
    return replace(scene, meshes=[*scene.meshes, Mesh("far", corners, np.array([[0, 1, 2]]), 0)])


def with_stray(scene, at):
    mesh = scene.meshes[0]
    moved = replace(mesh, vertices=np.concatenate((mesh.vertices, np.full((1, 3), at, np.float32))), uvs=None)
    return replace(scene, meshes=[moved, *scene.meshes[1:]])


def region(scene):
    return training_region(scene, training_paths(build_world(scene), scene))


def test_a_closed_room_is_spanned_whole_without_random_numbers_and_stray_vertices():
    before = torch.get_rng_state()
    found = region(CORNELL)
    assert torch.equal(before, torch.get_rng_state())
    assert np.array_equal(found.bounds, CORNELL.bounds)
    assert not found.contracted
    assert found.sentence(CORNELL) is None

    stray = with_stray(CORNELL, 1e3)
    assert np.array_equal(stray.bounds, CORNELL.bounds)
    assert "outside: 1 vertex that no triangle uses" in region(stray).sentence(stray)


@pytest.mark.parametrize("far", [10.0, 300.0, 1e9])
def test_a_far_triangle_leaves_the_room_its_cells(far):
    scene = with_triangle(CORNELL, far)
    found = region(scene)
    assert found.contracted
    assert found.outside == 0.0
    assert (found.bounds[0] <= CORNELL.bounds[0]).all()
    assert (found.bounds[1] >= CORNELL.bounds[1]).all()
    assert (found.bounds[1] - found.bounds[0]).max() < 1.15 * 2.0
    assert "parts of 1 of 39 triangles" in found.sentence(scene)
    assert found.radius < 2.0


def test_a_ground_to_the_horizon_leaves_the_object_its_cells_and_steps_off_surfaces_stay_small():
    plane = np.array([[-1e3, -1.002, -1e3], [-1e3, -1.002, 1e3], [1e3, -1.002, 1e3], [1e3, -1.002, -1e3]], np.float32)
    kept = [m for m in CORNELL.meshes if "block" in m.name or m.name == "light"]
    ground = replace(CORNELL, meshes=[*kept, Mesh("ground", plane, np.array([[0, 1, 2], [0, 2, 3]]), 0)])
    found = region(ground)
    assert found.contracted
    assert 0.0 < found.outside < 0.2
    assert (found.bounds[1] - found.bounds[0]).max() < 30.0

    usual = Geometry(CORNELL).scale
    assert Geometry(with_triangle(CORNELL, 1e9)).scale < 2 * OUTLYING * usual
    world = build_world(with_triangle(with_stray(CORNELL, 3e8), 1e9))
    assert world.tracer.tracer.extent < 2 * OUTLYING
    assert Geometry(with_triangle(CORNELL, 300.0)).scale > 200.0


def test_the_contraction_is_smooth_one_to_one_and_the_same_in_both_forms():
    bounds = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
    cube = UnitCube(bounds, contracted=True)
    x = torch.cat((-torch.logspace(9, -3, 4000), torch.zeros(1), torch.logspace(-3, 9, 4000)))
    p = x[:, None].expand(-1, 3).contiguous()
    y = cube(p)
    torch.testing.assert_close(y, cube.reference(p), rtol=0, atol=1e-7)
    assert (y >= 0).all()
    assert (y <= 1).all()
    near = x.abs() < 1e3
    assert (y[near, 0].diff() > 0).all()
    inside = cube(bounds)[:, 0]
    assert 1.0 - 2.0 * SHELL > float(inside[1] - inside[0]) > 0.97 * (1.0 - 2.0 * SHELL)
    step = torch.tensor([0.99, 1.0, 1.02, 1.03, 1.04])[:, None].expand(-1, 3).contiguous()
    slope = cube(step)[:, 0].diff() / step[:, 0].diff()
    assert (slope.diff().abs() < 0.15 * slope[0]).all()  # no kink at the side of the box
    odd = cube(torch.tensor([[torch.nan, torch.inf, -torch.inf]]))[0]
    assert odd[0].isnan()
    assert odd[1:].tolist() == [1.0, 0.0]


def test_all_parts_span_the_same_region_and_cells_are_counted_inside_it():
    settings = model_settings("cornell.yaml")
    scene = replace(with_triangle(CORNELL, 300.0), environment=None)
    near, far = assemble(CORNELL, settings), assemble(scene, settings)
    for made, shell in ((near, 0.0), (far, SHELL)):
        assert [float(f.cube.shell) for f in (made.materials.recovered["albedo"], made.radiance)] == pytest.approx(
            [shell, shell]
        )
    cells = [
        m.materials.recovered["albedo"].grid.level_table[-1, 0] * m.materials.recovered["albedo"].cube.inverse_side
        for m in (near, far)
    ]
    assert float(cells[1] / cells[0]) == pytest.approx(1.0, abs=0.1)
    config = FieldConfig(GridConfig(finest=1 << 20))
    assert far.region.stretched(config).grid.finest == 1 << 20
    assert near.region.stretched(config) is config
    dense = FieldConfig(kind="dense")
    assert far.region.stretched(dense) is dense


@pytest.mark.parametrize("far", [False, True])
def test_a_refinement_has_cells_as_small_as_those_of_the_fields(far):
    """Whole ones of its coarsest grid, so that every grid divides the finest."""
    scene = replace(with_triangle(CORNELL, 300.0) if far else CORNELL, environment=None)
    scene = with_material(scene, PrincipledModel(), 0.4, 0.3)
    settings = model_settings("scene.yaml")
    made = assemble(scene, settings)
    cells, finest = made.hierarchy.cells, made.materials.recovered["roughness"].grid.level_table[-1, 0]
    assert cells % max(DETAILS) == 0
    assert cells / float(finest) == pytest.approx(HIERARCHY_CELLS / settings.roughness.grid.finest, abs=0.05)
    assert far == (cells > HIERARCHY_CELLS)


def test_the_environment_is_weighed_by_what_the_region_gets_of_it():
    from neurad.core.scene_records import EnvironmentMap

    sky = EnvironmentMap(np.ones((2, 4, 3), np.float32))
    scene = replace(with_triangle(CORNELL, 300.0), environment=sky)
    lights = assemble(scene, model_settings("cornell.yaml")).world.lights
    assert isinstance(lights, Lights)
    assert lights.radius < 2.0


def test_a_fit_says_what_it_leaves_out_and_keeps_what_it_spans(tmp_path, monkeypatch, capfd):
    pytest.importorskip("mitsuba")
    monkeypatch.chdir(tmp_path)
    spans = []
    for version, extra in enumerate((0, 1)):
        folder = write_scene(tmp_path / f"room{extra}")
        if extra:
            ply = PLY.replace("element vertex 4", "element vertex 8").format(faces=3)
            far = "1000 9 0 0 0\n500 500 0 0 0\n500 501 0 0 0\n501 500 0 0 0\n"
            (folder / "meshes/floor.ply").write_text(f"{ply}{far}3 0 1 2\n3 0 2 3\n3 5 6 7\n")
        write_tiny_config(base="scene.yaml", data={"root": str(folder)})
        fit("--trainer.max_steps=2")
        said = [line for line in capfd.readouterr().err.splitlines() if "grids span" in line]
        assert len(said) == extra
        state = checkpoint(version)["state_dict"]
        spans.append(1.0 / float(state["materials.fields.albedo.cube.inverse_side"]) * (1.0 - 2.0 * SHELL * extra))
    assert "outside: 1 vertex that no triangle uses and parts of 1 of 5 triangles" in said[0]
    assert spans[1] == pytest.approx(spans[0], rel=0.2)
    main(["validate", "--config", "tiny.yaml", "--ckpt_path", "last"])
