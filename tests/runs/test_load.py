"""``neurad.load``: a run's scene, materials and radiance field without a Trainer, the same as ``neurad test`` shows."""

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from helpers.spoil import nothing, replaced, written
from helpers.tiny_scene import SIZE, write_scene

import neurad
from neurad.checkpoints.file import write_checkpoint
from neurad.cli import main
from neurad.core.errors import InputError
from neurad.evidence.bars_file import read_bars
from neurad.export.baking import bake_room
from neurad.images.image_io import read_exr
from neurad.metrics.held_out import HeldOut
from neurad.runtime.progress import Phase
from neurad.scene.geometry import Geometry
from neurad.scene.light import light_of
from neurad.scene.textures import TrueMaterials
from neurad.training.evaluate import SEED

pytest.importorskip("mitsuba")

REPOSITORY = Path(__file__).resolve().parents[2]
SPP = 3
GRID = {"levels": 3, "coarsest": 4, "finest": 16, "log2_size": 10}
CONFIG = {
    "seed_everything": 3,
    "trainer": {"max_steps": 40, "accelerator": "cpu", "enable_progress_bar": False},
    "data": {"root": "room", "patches": 64},
    "model": {
        "albedo": {"grid": GRID, "width": 16},
        "roughness": {"grid": GRID, "width": 16, "reads_albedo": True},
        "radiance": {"grid": GRID, "width": 16, "hidden_layers": 1},
        "optimization": {"average": 0.5, "schedule": "constant"},
    },
    "evaluation": {"every_n_steps": 1000, "spp": 1, "test_spp": SPP},
}


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """A folder in which ``neurad fit`` and then ``neurad test`` ran on a tiny scene."""
    folder = tmp_path_factory.mktemp("fitted")
    write_scene(folder / "room")
    (folder / "fit.yaml").write_text(yaml.safe_dump(CONFIG))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        main(["fit", "--config", "fit.yaml"])
        main(["test"])
    return folder


def test_error_bars_are_those_of_neurad_test(place):
    """At what a view shows they are within the range of its map; and a file of another iteration is not taken."""
    run = neurad.load(place)
    view = run.scene.test[0]
    points = run.surface(view)
    lit = points.valid.numpy()
    std = run.map_std("albedo", points)
    assert std.shape == (SIZE * SIZE, 3)
    assert (std[~lit] == 0).all()
    shown = read_exr(str(place / "images" / "000_albedo_std.exr")).reshape(SIZE * SIZE, -1)[:, :3]
    inner = lit & (shown > 0).all(1)
    assert inner.any()
    assert np.median(np.abs(std - shown)[inner] / shown[inner]) < 0.3
    at = run.map_std("albedo", points.p[points.valid].numpy())
    assert np.allclose(at, std[lit]) or (std[lit] == 0).any()
    with pytest.raises(InputError, match=r"did not refine it; set model\.roughness\.structure auto"):
        run.map_std("roughness", points)
    scores = json.loads((place / "metrics.json").read_text())
    assert run.map_std("albedo", points)[lit].std() > 0
    assert not any("coverage" in key for key in scores)  # the room has no true maps
    bars = place / "error_bars.npz"
    before = read_bars(bars).at(run.materials, points.p)["albedo"]
    assert before.std() > 0
    kept = bars.read_bytes()
    try:
        bars.unlink()
        main(["test"])  # in the trainer's inference mode, the same as at the end of the fit
        assert read_bars(bars).at(run.materials, points.p)["albedo"] == pytest.approx(before, rel=1e-3)
        bars.unlink()
        with pytest.raises(InputError, match="no error bars of this run; neurad test writes them"):
            neurad.load(place).map_std("albedo", points)
    finally:
        bars.write_bytes(kept)


@pytest.fixture
def place(fitted, monkeypatch):
    monkeypatch.chdir(fitted)
    return Path("lightning_logs/version_0")


def shown(place, index, name):
    """What ``neurad test`` wrote of a held-out view."""
    return read_exr(place / "images" / f"{index:03d}_{name}.exr")


def test_a_loaded_run_is_what_the_evaluation_of_the_module_shows(place):
    run = neurad.load(place)
    assert run.iteration == 40
    assert run.settings.roughness.reads_albedo
    assert run.materials.recovered["roughness"].reads_albedo
    assert run.radiance is not None
    maps = HeldOut(run.scene, run.world.geometry, run.world.tracer).predict(run.materials)
    for index, view in enumerate(run.scene.test):
        for name in ("albedo", "roughness"):
            truth = shown(place, index, name)
            np.testing.assert_array_equal(maps[index][name].reshape(truth.shape), truth)
        picture = run.render(view, SPP, SEED + index)
        assert picture.shape == (SIZE, SIZE, 3)
        np.testing.assert_array_equal(picture, shown(place, index, "render"))
        np.testing.assert_array_equal(run.render(view.name, SPP, SEED + index), picture)
        np.testing.assert_array_equal(run.render(view.camera, SPP, SEED + index), picture)


def test_what_no_photograph_shows_has_one_value_in_scores_in_python_and_in_an_export(place):
    pytest.importorskip("xatlas")
    run = neurad.load(place)
    unseen = replace(run.scene, train=[])
    held_out = HeldOut(unseen, run.world.geometry, run.world.tracer)
    assert not held_out.seen(0).any()
    (maps, _), ((_, points),) = held_out.predict(run.materials), held_out.sub_samples(0)
    for name in ("albedo", "roughness"):
        values = np.where(points.valid[:, None], run.map(name, points), 0.0)
        means = values.reshape(SIZE * SIZE, held_out.grid**2, -1).mean(1)
        np.testing.assert_allclose(maps[name].reshape(SIZE * SIZE, -1), means, rtol=1e-5)
    baked = replace(bake_room(run.assembly, 1 << 16, 64, None, Phase("export")).scene, train=[])
    geometry = Geometry(baked)
    (exported, _) = HeldOut(baked, geometry, run.world.tracer).predict(TrueMaterials(baked, geometry))
    for name in ("albedo", "roughness"):
        np.testing.assert_allclose(exported[name], maps[name], atol=0.01)


def test_values_at_points(place):
    """Positions read the fields; points of a view read the scene's own material on emitters, as the fit does."""
    run = neurad.load(place)
    points = run.surface(run.scene.train[0])
    surface = run.materials(points)
    np.testing.assert_array_equal(run.map("albedo", points), surface.albedo.detach().numpy())
    np.testing.assert_array_equal(run.map("roughness", points), surface.roughness.detach().numpy())
    emits = run.world.geometry.emission.amax(-1)[points.prim.clamp_min(0)] > 0
    bare = (points.valid & ~emits).numpy()
    assert bare.sum() > 3
    positions = points.p.numpy().astype(np.float64)
    albedo, roughness = run.map("albedo", positions), run.map("roughness", positions.tolist())
    assert albedo.shape == (SIZE * SIZE, 3)
    assert roughness.shape == (SIZE * SIZE, 1)
    np.testing.assert_allclose(albedo[bare], run.map("albedo", points)[bare], rtol=1e-6)
    np.testing.assert_allclose(roughness[bare], run.map("roughness", points)[bare], rtol=1e-6)
    assert run.map("albedo", np.zeros((0, 3))).shape == (0, 3)
    with pytest.raises(InputError, match=r"points: an array of shape \[n, 3\] is needed, not \[3\]"):
        run.map("albedo", [1.0, 2.0, 3.0])
    with pytest.raises(InputError, match="view attic: scene room has no view of that name"):
        run.render("attic")


@pytest.mark.parametrize("named", [None, "last", "lightning_logs/version_0/checkpoints/last.ckpt"])
def test_ways_to_name_a_run_and_what_it_says_of_itself_in_a_line(place, named):
    run = neurad.load(named)
    views = f"room of {len(run.scene.train)} training and {len(run.scene.test)} held-out views"
    assert repr(run) == f"LoadedRun('{place}/checkpoints/last.ckpt', iteration 40, {views}, cpu)"


def test_a_scene_is_found_from_elsewhere(place, tmp_path, monkeypatch):
    """A relative ``--data.root`` is that of the folder in which the fit ran; ``root`` says where a scene is now."""
    run = place.resolve()
    shutil.copytree("room", tmp_path / "moved")
    monkeypatch.chdir(tmp_path)
    assert neurad.load(run).iteration == 40
    assert light_of(neurad.load(run, root="moved").scene) == light_of(neurad.load(run).scene)


LAST, CONFIGURED = "version_0/checkpoints/last.ckpt", "version_0/config.yaml"
BAD = {
    "no run": (nothing, "version_9", r"run .*version_9: there is no such run folder or checkpoint"),
    "no checkpoint": (
        lambda folder: shutil.rmtree(folder / "version_0/checkpoints"), "version_0",
        r"run .*version_0: it has no checkpoint"),
    "broken": (
        written(LAST, "x"), "version_0",
        r"run .*version_0: it has no whole checkpoint \(.*last\.ckpt: it is not a readable checkpoint"),
    "elsewhere": (
        lambda folder: shutil.copy(folder / LAST, folder / "kept.ckpt"), "kept.ckpt",
        r"run .*kept\.ckpt: the checkpoint is not in a run folder with a config\.yaml"),
    "foreign": (
        lambda folder: write_checkpoint({"state_dict": {}}, folder / LAST), "version_0",
        r"run .*last\.ckpt: it is not a checkpoint of neurad"),
    "moved": (
        replaced(CONFIGURED, "root: room", "root: attic"), "version_0",
        r"run .*version_0: its scene attic is missing; say where it is now with --root"),
    "other sizes": (
        replaced(CONFIGURED, "width: 16", "width: 8", -1), "version_0",
        r"run .*last\.ckpt: the checkpoint has other field sizes than the config"),
    "unknown key": (
        replaced(CONFIGURED, "reads_albedo:", "reads_colour:"), "version_0", r"version_0/config\.yaml: .*reads_colour"),
    "a number that no float holds": (
        replaced(CONFIGURED, "chroma_weight:", f"chroma_weight: {10**400} #"), "version_0",
        r"version_0/config\.yaml: model\.objective\.chroma_weight: the number is too large"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_a_run_that_cannot_be_loaded_is_named(place, tmp_path, case):
    spoil, named, said = BAD[case]
    shutil.copytree("lightning_logs", tmp_path / "lightning_logs")
    spoil(tmp_path / "lightning_logs")
    with pytest.raises(InputError, match=said) as error:
        neurad.load(tmp_path / "lightning_logs" / named)
    assert "\n" not in str(error.value)


def test_a_run_of_another_scene_is_named(place, tmp_path):
    floor = write_scene(tmp_path / "hall") / "meshes/floor.ply"
    floor.write_text(floor.read_text().replace("-1 0 1 0 0", "-2 0 1 0 0"))
    with pytest.raises(InputError, match=r"the checkpoint is of scene room, not of hall as given"):
        neurad.load(place, root=tmp_path / "hall")


def test_import_stays_instant():
    """Nothing heavy, and no module beside the package's own first one."""
    code = (
        "import sys; import neurad; neurad.load; "
        "print([m for m in sys.modules if m.partition('.')[0] in ('torch', 'lightning', 'numpy', 'jsonargparse')])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_the_notebook_runs(fitted, monkeypatch):
    """Its cells, in order, in the folder of the fit."""
    monkeypatch.chdir(fitted)
    monkeypatch.setenv("MPLBACKEND", "agg")
    notebook = json.loads((REPOSITORY / "docs/load_a_run.ipynb").read_text())
    cells = ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]
    made: dict = {}
    exec("\n\n".join(cells), made)
    assert made["picture"].shape == made["albedo"].shape == (*made["size"], 3)
    assert made["roughness"].shape == made["size"]
    made["plt"].close("all")
