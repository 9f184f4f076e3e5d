"""Metal is found by a fit, or kept where the files know of it, while base colour and roughness are found."""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from benchmarks.stress.fit import Fit, Plan, glossy, photographs, resized, small_cube, small_settings, with_material
from neurad.core.parameters import METALLIC
from neurad.core.reflection import PrincipledModel
from neurad.core.scene_records import DIELECTRIC, METAL, Constant, Mesh, constant
from neurad.export.baking import bake_room
from neurad.export.base_colour import coded
from neurad.images.image_io import read_bitmap
from neurad.integrators.film import render
from neurad.integrators.renderer import MaterialMap
from neurad.metrics.held_out import HeldOut
from neurad.runtime.progress import Phase
from neurad.scene.builtin import build_cornell
from neurad.scene.textures import TrueMaterials
from neurad.training.metal import SHARE, UNDECIDED

ALBEDO, ROUGHNESS = 0.6, 0.4


def metal_box():
    """A Cornell box of principled walls, every second of which is of metal."""
    scene = glossy(resized(build_cornell(), 24))
    paint = Constant(np.full(3, ALBEDO, np.float32))
    materials = [
        replace(m, albedo=paint, roughness=constant(ROUGHNESS), metallic=METAL if i % 2 else DIELECTRIC)
        for i, m in enumerate(scene.materials)
    ]
    return replace(scene, materials=materials)


def plan(recover):
    settings = small_settings()
    return Plan(steps=200, settings=replace(settings, metallic=replace(settings.metallic, recover=recover)))


@pytest.fixture(scope="module")
def room():
    """The room and its photographs."""
    scene = metal_box()
    return scene, photographs(scene, 128)


@pytest.fixture(scope="module")
def fits(room):
    """Fits of photographs of the room: one that knows its metal, one that takes all for dielectrics, and one that finds
    it."""
    (scene, images), found = room, []
    without = replace(scene, materials=[replace(m, metallic=DIELECTRIC) for m in scene.materials])
    for known, recover in ((scene, "none"), (without, "none"), (scene, "fit")):
        with pytest.MonkeyPatch.context() as patch:
            patch.setitem(SHARE, "fit", 1.5)  # 200 steps draw next to no samples
            fit = Fit(known, images, plan(recover)).run()
        si = fit.seen(4096)
        with torch.no_grad():
            truth, surface = TrueMaterials(scene, fit.world.geometry)(si), fit.surface(si)
        metal = truth.metallic.squeeze(-1) > 0
        off = [(surface.albedo - truth.albedo)[metal], (surface.roughness - truth.roughness)[metal]]
        found.append((fit, surface, truth, [float(x.square().mean().sqrt()) for x in off]))
    return found


@pytest.mark.parametrize(
    ("recover", "named", "other"), [("none", False, False), ("auto", False, True), ("fit", True, True)]
)
def test_metals_are_looked_for_where_no_file_names_them_or_always(room, recover, named, other):
    scene, images = room
    without = replace(scene, materials=[replace(m, metallic=DIELECTRIC) for m in scene.materials])
    looks = [
        Fit(known, images, plan(recover)).training.assembly.materials.metalness is not None
        for known in (scene, without)
    ]
    assert looks == [named, other]


def test_metal_is_kept_and_base_colour_and_roughness_are_found(fits):
    (fit, surface, truth, kept), (_, without, _, lost), _ = fits
    assert METALLIC in fit.scene.parameters
    assert torch.equal(surface.metallic, truth.metallic)
    assert without.metallic is None
    assert 0.2 < float(truth.metallic.mean()) < 0.8
    assert kept[0] < 0.06
    assert kept[0] < 0.5 * lost[0], "a fit that takes metal for a dielectric stains it"
    assert kept[1] < max(0.1, lost[1])
    assert [name for name, p in fit.materials.named_parameters() if "metallic" in name] == []


def test_metal_is_found(fits):
    """What files say of it plays no part. Eight views are enough for two of the four metals, and for no mistake."""
    (_, other, _, _), (_, lost, _, _), (fit, surface, truth, _) = fits
    assembly = fit.training.assembly
    assert METALLIC not in assembly.scene.parameters
    assert METALLIC in assembly.parameters
    assert assembly.metalness.done
    metal, found = truth.metallic > 0, surface.metallic > 0
    assert not bool((found & ~metal).any())
    assert float(found[metal].float().mean()) > 0.4
    kept, lost, found = (
        float((x.albedo - truth.albedo)[found.squeeze(-1)].square().mean().sqrt()) for x in (other, lost, surface)
    )
    assert found < max(1.5 * kept, 0.5 * lost)
    std = fit.materials.std(fit.seen(64).p)["metallic"]
    assert 0.0 < float(std.max()) <= 0.5


def test_metal_is_found_in_a_scan_in_one_piece(room, fits, monkeypatch):
    """Its parts are told by their colours, and no wall of paint is among them."""
    monkeypatch.setitem(SHARE, "fit", 1.5)
    scene, images = room
    plain, lamps = ([m for m in scene.meshes if (m.radiance is not None) == shines] for shines in (False, True))
    first = np.cumsum([0, *(len(mesh.vertices) for mesh in plain)])
    faces = [mesh.faces + before for mesh, before in zip(plain, first, strict=False)]
    scan = Mesh("scan", np.concatenate([mesh.vertices for mesh in plain]), np.concatenate(faces), plain[0].material)
    fit = Fit(replace(scene, meshes=[scan, *lamps]), images, replace(plan("fit"), steps=600)).run()
    points = fits[0][0].seen(4096)
    metal = fits[0][0].surface(points).metallic.squeeze(-1) > 0
    found = fit.materials.metalness.at(points.p).squeeze(-1)
    assert float(found[metal].mean()) > 0.25
    assert float(found[~metal].mean()) < 0.01


def test_a_room_that_is_all_of_metal(monkeypatch, capfd):
    """The prior that few things are metals gives way, and the lamp, which is known, is not said to be one."""
    monkeypatch.setitem(SHARE, "fit", 1.5)
    scene = metal_box()
    scene = replace(scene, materials=[replace(material, metallic=METAL) for material in scene.materials])
    fit = Fit(scene, photographs(scene, 128), plan("fit")).run()
    assert float(fit.surface(fit.seen(4096)).metallic.mean()) > 0.5
    (said,) = [line for line in capfd.readouterr().err.splitlines() if "metal is" in line]
    assert not {mesh.name for mesh in scene.meshes if mesh.radiance is not None} & set(re.findall(r"\w+", said))


@pytest.mark.parametrize("index", [0, 2])
def test_maps_of_a_room_with_metal_have_it(fits, index):
    fit = fits[index][0]
    scene, world = fit.scene, fit.world
    (maps, *_) = HeldOut(replace(scene, test=scene.train[:1]), world.geometry, world.tracer).predict(fit.materials)
    assert maps.keys() == {"albedo", "roughness", "metallic"}
    assert {0.0, 1.0} <= set(np.unique(maps["metallic"]))
    shown = render(scene.train[0].camera, MaterialMap(world, fit.materials, scene.parameters), 4, 0).numpy()
    assert shown.shape[-1] == 5
    np.testing.assert_allclose(shown[..., 4:].mean(), maps["metallic"].mean(), atol=0.02)


@pytest.mark.parametrize("index", [0, 2])
def test_an_export_has_the_metal(fits, tmp_path, index):
    pytest.importorskip("xatlas")
    fit = fits[index][0]
    room = bake_room(fit.training.assembly, 1 << 14, 32, None, Phase("export"))
    metalness = fit.training.assembly.metalness
    first = np.cumsum([0, *(len(mesh.faces) for mesh in fit.scene.meshes)])
    for index, mesh in enumerate(room.scene.meshes):
        of_metal = fit.scene.meshes[index].material % 2 == 1
        if metalness is not None:
            of_metal = bool(metalness.at(torch.zeros(1, 3), torch.tensor([first[index]])))
        assert (float(room.scene.materials[mesh.material].metallic.value[0]) > 0.5) == of_metal
        (tmp_path / "orm.png").write_bytes(coded(room.baked[index].maps, "exact").orm)
        assert (read_bitmap(tmp_path / "orm.png")[..., 2] > 0.5).all() == of_metal


def test_a_fit_that_draws_too_little_to_decide_says_so(capfd):
    scene = with_material(small_cube(24), PrincipledModel(), 0.4, 0.3)
    fit = Fit(scene, photographs(scene, 4), replace(plan("auto"), steps=8)).run()
    assert fit.training.assembly.metalness.done
    assert UNDECIDED in capfd.readouterr().err


def test_a_room_without_metal_is_fitted_as_before(monkeypatch):
    """The look at the pixels changes nothing of the fit but what it finds, and finds none."""
    monkeypatch.setitem(SHARE, "auto", 1.0)
    scene = with_material(small_cube(24), PrincipledModel(), 0.4, 0.3)
    images, found = photographs(scene, 64), []
    for recover in ("none", "auto"):
        settings = plan(recover).settings
        free = replace(settings, roughness=replace(settings.roughness, structure="free"))
        found.append(Fit(scene, images, Plan(steps=60, settings=free)).run())
    before, after = (fit.training.assembly for fit in found)
    assert after.metalness.done
    assert found[1].training.step.counters.samples > found[0].training.step.counters.samples
    assert after.parameters == before.parameters
    assert found[1].surface(found[1].seen(64)).metallic is None
    mine, theirs = (dict(assembly.materials.named_parameters()) for assembly in (before, after))
    assert mine.keys() == theirs.keys()
    assert all(torch.equal(mine[name], theirs[name]) for name in mine)
    assert all(map(torch.equal, before.radiance.parameters(), after.radiance.parameters()))
