"""Fits of rooms whose lamps nobody measured, through the command line: what they find, write and say."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import yaml
from helpers.lamp_room import CEILING, SIZE, STRIP, in_one_mesh, lamp_room
from helpers.lamp_room import photographed as photographed_room
from helpers.lamp_scene import TRUTH, declared, unmeasured, with_lamps
from helpers.method_oracles import gallery
from helpers.object_scene import sky
from helpers.small_fit import SMALL_FIT
from helpers.tables import csv_rows
from helpers.tiny_fit import fails

from neurad import load
from neurad.assembly.relight import recovered_scene
from neurad.cli import main
from neurad.core.errors import InputError
from neurad.core.scene_records import PunctualLight
from neurad.emitters.lights import join
from neurad.emitters.punctual import PunctualLights
from neurad.fields.development import FittedDevelopment
from neurad.images.image_io import read_exr, write_exr
from neurad.inspect.lamps import lamp_renderer, lamps_of
from neurad.lamps.responses import Responses, connected, indistinguishable, nonnegative_least_squares, other_lights
from neurad.lamps.scores import columns_of, lamp_scores, read_lamps_true
from neurad.lamps.unknown import rows
from neurad.scene import builtin
from neurad.scene.builtin.shapes import quad

FOLDER = Path("lightning_logs/version_0")
CHEAP = {"sampling": {"spp": 2, "cached_spp": 4, "samples_per_vertex": 2}}


def register(patch, scene, steps, truth, **data):
    """A scene as the built-in one 'small', a config of its fit, and the true radiance of its lamps by name."""
    patch.setitem(builtin._BUILDERS, "small", lambda: scene)
    config = {**SMALL_FIT, "model": {**SMALL_FIT["model"], **CHEAP}, "data": {"scene": "small", "patches": 64, **data}}
    config["trainer"] = {**SMALL_FIT["trainer"], "max_steps": steps}
    Path("fit.yaml").write_text(yaml.safe_dump(config))
    rows = [",".join(map(str, (name, *rgb))) for name, rgb in truth.items()]
    Path("true.csv").write_text("\n".join(["mesh,r,g,b", *rows, ""]))


@pytest.fixture(scope="module")
def photographed(tmp_path_factory):
    """The box with and without a photograph of its lamp."""
    scene = unmeasured(tmp_path_factory.mktemp("photographs"))
    return {True: scene, False: replace(scene, train=scene.train[:-1])}


@pytest.fixture
def box(tmp_path, monkeypatch, photographed):
    """Registers a box as the built-in scene 'small'."""
    monkeypatch.chdir(tmp_path)

    def make(shown=True):
        register(monkeypatch, photographed[shown], 2, {"light": TRUTH}, lamps_true="true.csv")
        return photographed[shown]

    return make


def fit(*args):
    main(["fit", "--config", "fit.yaml", *args])


@pytest.mark.parametrize("emitters", ["photographs", "fit", "find"])
def test_a_lamp_that_photographs_show_is_found(box, capsys, emitters):
    box()
    fit("--trainer.max_steps=66", f"--model.lighting.emitters={emitters}")
    said = capsys.readouterr()
    (row,) = csv_rows(FOLDER / "lamps.csv")
    assert list(row) == ["mesh", "r", "g", "b", "pixels", "views", "clipped", "scale"]
    assert row["mesh"] == "light"
    assert (int(row["pixels"]) > 20, row["clipped"], row["scale"]) == (True, "0", "seen")
    np.testing.assert_allclose([float(row[c]) for c in "rgb"], TRUTH, rtol=0.03)
    last = csv_rows(FOLDER / "metrics.csv")[-1]
    assert float(last["lamp_error_light"]) < 0.03
    assert ("lamp_error_scaled1_light" in last) is (emitters != "photographs")
    assert [last.get(f"lamps_{kind}") for kind in ("missed", "extra")] == 2 * ["0" if emitters == "find" else None]
    assert "lamp_mismatch" not in said.err
    assert "warning" not in said.err
    assert "Lamps\nlamp" in said.out
    assert "seen" in said.err
    run = load(FOLDER)
    np.testing.assert_allclose(run.assembly.lamps.found()[0], [float(row[c]) for c in "rgb"], rtol=1e-5)
    mesh = next(m for m in recovered_scene(run.assembly).meshes if m.name == "light")
    np.testing.assert_allclose(mesh.radiance, TRUTH, rtol=0.03)
    alone = lamp_renderer(run.assembly, lamps_of(run.assembly)[0])
    assert float(alone.scene.world.lights.emission.max()) == pytest.approx(17.0, rel=0.03)
    assert len(torch.load(FOLDER / "checkpoints/last.ckpt", weights_only=True)["optimizer_states"]) == (
        2 if emitters == "photographs" else 3
    )


@pytest.mark.parametrize(("shown", "factor"), [(True, 1.03), (False, 1.3)])
def test_what_a_hint_says_shines_is_a_lamp_whose_radiance_is_found(box, monkeypatch, capfd, shown, factor):
    """In a room of whose file nothing shines: by a point on a lamp that is photographed, or a box around another."""
    scene = box(shown)
    dark = replace(scene, meshes=[replace(mesh, radiance=None) for mesh in scene.meshes])
    monkeypatch.setitem(builtin._BUILDERS, "small", lambda: dark)
    assert "shines" in fails(capfd, "fit", "--config", "fit.yaml")
    light = next(mesh for mesh in scene.meshes if mesh.radiance is not None)
    point = light.vertices[light.faces[0]].mean(0)
    place = point if shown else np.concatenate((light.vertices.min(0) - 1e-3, light.vertices.max(0) + 1e-3))
    Path("hints.yaml").write_text(yaml.safe_dump([{"shines": [float(x) for x in place]}]))
    fit("--trainer.max_steps=66", "--data.hints=hints.yaml")
    (row,) = csv_rows(sorted(Path("lightning_logs").iterdir())[-1] / "lamps.csv")
    assert row["mesh"] == "light"
    assert (np.abs(np.log(np.array([float(row[c]) for c in "rgb"]) / TRUTH)) < np.log(factor)).all()


@pytest.fixture(scope="module")
def unlike(tmp_path_factory):
    """The photograph that shows the lamp is twice as bright as the others; it shows walls that they show, too."""
    scene = unmeasured(tmp_path_factory.mktemp("unlike"), distance=1.8)
    gains = np.where([view is scene.train[-1] for view in scene.train], 2.0, 1.0)
    for view, gain in zip(scene.train, gains / np.exp(np.log(gains).mean()), strict=True):
        write_exr(view.image, read_exr(view.image) * np.float32(gain), half=False)
    return scene


@pytest.mark.parametrize("emitters", ["photographs", "fit", "known"])
def test_photographs_of_unlike_exposures_show_the_lamp(box, unlike, monkeypatch, capsys, emitters):
    box()
    scene = declared(unlike, TRUTH) if emitters == "known" else unlike
    monkeypatch.setitem(builtin._BUILDERS, "small", lambda: scene)
    fit("--data.exposure=fit", f"--model.lighting.emitters={emitters}")
    said = capsys.readouterr().err
    assert "gains begin" in said
    assert "warning" not in said.lower()
    if emitters != "known":
        (row,) = csv_rows(FOLDER / "lamps.csv")
        np.testing.assert_allclose([float(row[c]) for c in "rgb"], TRUTH, rtol=0.1)


@pytest.mark.parametrize("joined", [False, True])
def test_a_run_that_found_its_lamps_goes_on_with_them(box, monkeypatch, capsys, joined):
    """To the same bits, whatever the scene says shines by then, and without looking for lamps again."""
    scene = in_one_mesh(box())[0] if joined else box()
    monkeypatch.setitem(builtin._BUILDERS, "small", lambda: scene)
    find = ["--model.lighting.emitters=find", "--data.lamps_true=null", "--model.optimization.schedule=constant"]
    fit(*find, "--trainer.max_steps=4")
    fit(*find, "--trainer.max_steps=2")
    assert f"{'scan_lamp_1' if joined else 'light'} shines: it is" in capsys.readouterr().err
    dark = replace(scene, meshes=[replace(m, radiance=None) for m in scene.meshes])
    monkeypatch.setitem(builtin._BUILDERS, "small", lambda: dark)
    main(["fit", "--ckpt_path=version_1", "--trainer.max_steps=4"])
    assert "shines" not in capsys.readouterr().err
    whole, parts = (torch.load(f"lightning_logs/version_{i}/checkpoints/last.ckpt", weights_only=True) for i in (0, 1))
    assert whole["neurad"]["shining"] == parts["neurad"]["shining"]
    for name, value in whole["state_dict"].items():
        assert torch.equal(value, parts["state_dict"][name]), name
    meshes = load("lightning_logs/version_1").scene.meshes
    assert [mesh.name for mesh in meshes if mesh.radiance is not None] == ["scan_lamp_1" if joined else "light"]
    main(["validate", "--ckpt_path=version_1"])


@pytest.fixture(scope="module")
def joined(tmp_path_factory):
    """A photographed room whose two lamps, unlike each other, are one mesh of radiance 1."""
    folder, scene = tmp_path_factory.mktemp("joined"), lamp_room()
    pictures = photographed_room(scene).pixels.view(len(scene.train), SIZE, SIZE, 3).numpy()
    views = []
    for view, picture in zip(scene.train, pictures, strict=True):
        views.append(replace(view, image=str(folder / f"{view.name}.exr")))
        write_exr(views[-1].image, picture, half=False)
    both = [mesh for mesh in scene.meshes if mesh.radiance is not None]
    parts = [replace(mesh, radiance=None) for mesh in scene.meshes if mesh.radiance is None]
    faces = np.concatenate((both[0].faces, both[1].faces + len(both[0].vertices)))
    vertices, uvs = (np.concatenate([getattr(mesh, name) for mesh in both]) for name in ("vertices", "uvs"))
    one = replace(both[0], name="lamps", faces=faces, vertices=vertices, uvs=uvs, radiance=np.ones(3, np.float32))
    return replace(scene, name="small", meshes=[*parts, one], train=views, test=views[:1])


@pytest.fixture
def two_in_one(tmp_path, monkeypatch, joined):
    """Registers it as the built-in scene 'small'."""
    monkeypatch.chdir(tmp_path)
    register(monkeypatch, joined, 66, {"lamps_1": CEILING, "lamps_2": STRIP})


@pytest.mark.parametrize("emitters", ["fit", "photographs"])
def test_parts_of_a_lamp_shine_each_by_itself(two_in_one, emitters):
    """Said by the setting; the run is read back and goes on with the parts as lamps."""
    fit(f"--model.lighting.emitters={emitters}", "--model.lighting.split_lamps=true", "--data.lamps_true=true.csv")
    found = {row["mesh"]: [float(row[c]) for c in "rgb"] for row in csv_rows(FOLDER / "lamps.csv")}
    np.testing.assert_allclose(found["lamps_1"], CEILING, rtol=0.05)
    np.testing.assert_allclose(found["lamps_2"], STRIP, rtol=0.05)
    assert float(csv_rows(FOLDER / "metrics.csv")[-1]["lamp_error_lamps_2"]) < 0.05
    assert [mesh.name for mesh in load(FOLDER).scene.meshes if mesh.radiance is not None] == ["lamps_1", "lamps_2"]
    main(["fit", "--ckpt_path=version_0", "--trainer.max_steps=68"])
    assert [row["mesh"] for row in csv_rows(FOLDER / "lamps.csv")] == ["lamps_1", "lamps_2"]
    assert csv_rows(FOLDER / "metrics.csv")[-1]["iteration"] == "68"


@pytest.mark.parametrize(("emitters", "ceiling"), [("fit", 0.8), ("photographs", 0.8), ("fit", None)])
def test_clipped_lamps_begin_as_bright_as_what_they_light_says(
    two_in_one, joined, monkeypatch, capsys, emitters, ceiling
):
    """At 0.8 a tenth of the brighter one is left; the strip, whose red is not clipped, has a twentieth of all light."""
    views = [replace(view, image=f"{view.name}.exr") for view in joined.train]
    for view, whole in zip(views, joined.train, strict=True):
        write_exr(view.image, np.minimum(read_exr(whole.image), np.float32(0.8)), half=False)
    monkeypatch.setitem(builtin._BUILDERS, "small", lambda: replace(joined, train=views))
    told = [] if ceiling is None else [f"--data.ceiling={ceiling}"]
    fit(f"--model.lighting.emitters={emitters}", "--model.lighting.split_lamps=true", "--trainer.max_steps=2", *told)
    found = {row["mesh"]: row for row in csv_rows(FOLDER / "lamps.csv")}
    assert all(int(row["clipped"]) == int(row["pixels"]) > 10 for row in found.values())
    radiance = {name: [float(row[c]) for c in "rgb"] for name, row in found.items()}
    np.testing.assert_allclose(radiance["lamps_1"], CEILING, rtol=0.1)
    np.testing.assert_allclose(radiance["lamps_2"], STRIP, rtol=0.35)
    assert "lamp lamps_1 is clipped in every photograph: its radiance" in capsys.readouterr().err


def test_known_lamps_are_not_split(two_in_one, capfd):
    error = fails(capfd, "fit", "--config", "fit.yaml", "--model.lighting.split_lamps=true")
    assert "model.lighting.split_lamps: it splits lamps whose radiance is recovered" in error


def test_no_lamp_is_found_where_no_photograph_shows_it(box, capfd):
    box(shown=False)
    error = fails(capfd, "fit", "--config", "fit.yaml", "--model.lighting.emitters=find")
    assert "no mesh shines in the photographs" in error


def test_a_lamp_that_no_photograph_shows(box, capfd):
    """It begins as bright as what it lights says."""
    box(shown=False)
    error = fails(capfd, "fit", "--config", "fit.yaml", "--model.lighting.emitters=photographs")
    assert "no photograph shows a lamp alone in a pixel" in error
    assert "take fit" in error
    fit("--model.lighting.emitters=fit")
    (row,) = csv_rows(sorted(Path("lightning_logs").iterdir())[-1] / "lamps.csv")
    assert (row["scale"], row["pixels"]) == ("weak", "0")
    found = np.array([float(row[c]) for c in "rgb"])
    assert (np.abs(np.log(found / TRUTH)) < np.log(1.1)).all()


def test_the_scale_of_a_lamp_is_seen_in_unclipped_pixels_of_its_own_alone():
    """The ceiling lamp is clipped wherever it is shown; its light meets that of the strip, and then it does not."""
    scene = lamp_room()
    _, lamps = with_lamps(scene)
    assembly = SimpleNamespace(scene=scene, lamps=lamps, world=SimpleNamespace(flash=None))
    lamps.counts.copy_(torch.tensor([[40, 3, 40], [30, 2, 4]]))
    for fixed, scales in (([True, True], ["shared", "seen"]), ([False, True], ["weak", "seen"])):
        lamps.scale_seen.copy_(torch.tensor(fixed))
        assert [row["scale"] for row in rows(assembly)] == scales


def test_lamps_that_cannot_be_told_apart_and_one_in_a_closed_box_are_named(box, capsys, monkeypatch):
    """In place of the lamp there are two strips beside each other, and one inside of the tall block."""
    scene = box(shown=False)
    light = next(mesh for mesh in scene.meshes if mesh.radiance is not None)
    strips = [
        quad(corner, (0.02, 0, 0), (0, 0, 0.02)).mesh(
            name, light.material, smooth_shading=False, radiance=light.radiance
        )
        for name, corner in (("left", (-0.02, 0.99, 0)), ("right", (0.0, 0.99, 0)), ("buried", (-0.35, -0.5, -0.3)))
    ]
    other = replace(scene, meshes=[*(mesh for mesh in scene.meshes if mesh is not light), *strips])
    monkeypatch.setitem(builtin._BUILDERS, "small", lambda: other)
    Path("true.csv").write_text("mesh,r,g,b\nleft,1,1,1\nright,1,1,1\nburied,1,1,1\n")
    fit("--model.lighting.emitters=fit")
    said = capsys.readouterr().err
    assert "warning: the light of lamp buried reaches no surface that the photographs show" in said
    assert "warning: lamps left, right light what the photographs show alike" in said
    found = {row["mesh"]: row for row in csv_rows(FOLDER / "lamps.csv")}
    assert float(found["buried"]["r"]) == pytest.approx(1.0, rel=0.05)  # the scene's, but for two steps
    corners = light.vertices[light.faces]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1).sum()
    both = 0.02 * 0.02 * np.array([[float(found[name][c]) for c in "rgb"] for name in ("left", "right")])
    np.testing.assert_allclose(both.sum(0), area * TRUTH, rtol=0.2)
    assert both.min(0).tolist() > (0.1 * area * TRUTH).tolist()


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("mesh,r,g\nlight,1,2\n", "no column b"),
        ("mesh,r,g,b\nlight,1,2,3\nlight,4,4,4\n", "lamp light stands in it twice"),
        ("mesh,r,g,b\nlamp,1,2,3\n", "lamp light of the scene is not in it"),
        ("mesh,r,g,b\nlight,1,-2,3\n", "three numbers from 0"),
        ("mesh,r,g,b\nlight,1,x,3\n", "three numbers from 0"),
    ],
)
def test_a_table_of_the_truth_that_is_wrong_is_refused(tmp_path, text, says):
    path = tmp_path / "true.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=says) as refused:
        read_lamps_true(str(path), ["light"])
    assert "true.csv" in str(refused.value)


def test_a_part_is_as_bright_as_the_whole_unless_the_table_says_more(tmp_path):
    path = tmp_path / "true.csv"
    path.write_text("mesh,r,g,b\nlight,1,2,3\nlight_2,4,4,4\n")
    names, wholes = ["light_1", "light_2"], {"light_1": "light", "light_2": "light"}
    truth, missed = read_lamps_true(str(path), names, wholes=wholes)
    np.testing.assert_array_equal(truth, [[1, 2, 3], [4, 4, 4]])
    assert missed == 0
    with pytest.raises(InputError, match="lamp light_1 of the scene is not in it"):
        read_lamps_true(str(path), names)
    path.write_text("mesh,r,g,b\nlight,1,2,3\nlight_1,3,3,3\nlight_2,4,4,4\n")
    truth, missed = read_lamps_true(str(path), names, wholes=wholes)
    np.testing.assert_array_equal(truth, [[3, 3, 3], [4, 4, 4]])
    assert missed == 0


def test_lamps_found_wrongly_and_not_found_are_counted(tmp_path):
    path = tmp_path / "true.csv"
    path.write_text("mesh,r,g,b\nlight,1,2,3\nwindow,4,4,4\nshade,0,0,0\n")
    truth, missed = read_lamps_true(str(path), ["light", "door"], found=True)
    np.testing.assert_array_equal(truth, [[1, 2, 3], [0, 0, 0]])
    assert missed == 1
    scores = lamp_scores(np.array([[1.0, 2.0, 3.0], [5.0, 5.0, 5.0]]), truth, ["light", "door"], {})
    assert (scores["lamp_error_light"], scores["lamp_error_door"], scores["lamp_error"]) == (0.0, 1.0, 1.0)
    truth, missed = read_lamps_true(str(path), [], found=True)
    assert (truth.shape, missed) == ((0, 3), 2)
    assert lamp_scores(truth, truth, [], {}) == {}


def test_errors_of_lamps_by_hand():
    found, truth = np.array([[2.0, 1.0, 0.0], [1.0, 1.1, 1.0]]), np.array([[1.0, 1.0, 0.01], [1.0, 1.0, 1.0]])
    factors = {"scaled3": np.array([2.0, 1.0, 1.0])}
    scores = lamp_scores(found, truth, ["a,b", "c"], factors)
    assert scores == pytest.approx(
        {
            "lamp_error": 1.0, "lamp_error_a_b": 1.0, "lamp_error_c": 0.1,
            "lamp_error_scaled3": 0.5, "lamp_error_scaled3_a_b": 0.2, "lamp_error_scaled3_c": 0.5,
        }
    )  # fmt: skip
    assert columns_of(["x", "y", "x"]) == ["x_0", "y", "x_2"]


# ---- lamps that no photograph shows, on pictures made up


def pictures(seed, count=5, pixels=300):
    """Independent patterns of light [m, n, 3], positive."""
    return np.random.default_rng(seed).gamma(1.0, 1.0, (count, pixels, 1)) * np.ones(3)


def noisy(light, sigma=0.05, seed=5):
    rng = np.random.default_rng(seed)
    return np.stack([light * (1 + sigma * rng.standard_normal(light.shape)) for _ in range(2)])


def test_unseen_lamps_are_explained_beside_seen_ones_whatever_the_albedo():
    light, radiance = pictures(1, 3), np.array([[4.0, 3.0, 2.0], [1.0, 5.0, 0.5], [0.7, 0.7, 7.0]])
    photographs = 1.7 * np.einsum("mc,mnc->nc", radiance, light)  # surfaces are brighter than they are taken for
    responses = Responses(noisy(light), None, None, photographs)
    told = np.array([True, False, False])
    found = nonnegative_least_squares(
        responses, np.where(told[:, None], radiance, 1.0), told, indistinguishable(responses, told)
    )
    np.testing.assert_allclose(found[1:], radiance[1:], rtol=0.1)


def test_light_of_other_kinds_is_known_and_an_unknown_sky_is_set_free():
    light = pictures(6, 4)
    photographs = 0.6 * (light[0] + 3.0 * light[1] + 2.0 * light[2] + 5.0 * light[3])
    responses = Responses(noisy(light[1:3]), light[0], light[3], photographs)
    none = np.zeros(2, bool)
    found = nonnegative_least_squares(responses, np.ones((2, 3)), none, indistinguishable(responses, none))
    np.testing.assert_allclose(found, [[3.0] * 3, [2.0] * 3], rtol=0.1)


def test_what_is_no_lamp_is_found_in_any_mixture_of_lights():
    world, lamps = with_lamps(gallery(), sky())
    assert other_lights(world, None) is world.lights.second
    assert other_lights(world, world.lights.second) is None
    points = PunctualLights([PunctualLight("bulb", "point", np.ones(3, np.float32))])
    world.lights = join(lamps, world.lights.second, points, 1.0)
    both = other_lights(world, None)
    assert (both.first, both.second) == (points, world.lights.second.second)
    world.lights = lamps
    assert other_lights(world, None) is None


def test_scale_goes_from_lamp_to_lamp_where_their_light_meets():
    light = pictures(3, 4)
    light[:2, 150:] = 0.0
    light[2:, :150] = 0.0
    responses = Responses(noisy(light), None, None, light.sum(0))
    told = np.array([True, False, False, False])
    np.testing.assert_array_equal(connected(responses, np.ones((4, 3)), told), [True, True, False, False])
    beside = replace(responses, known=np.ones((300, 3)))
    assert connected(beside, np.ones((4, 3)), told).all()
    unknown = replace(responses, sky=np.ones((300, 3)))  # its light meets that of all, and hands the scale on
    assert connected(unknown, np.ones((4, 3)), told).all()
    assert not connected(unknown, np.ones((4, 3)), np.zeros(4, bool)).any()


@pytest.mark.parametrize("method", ["radiometric.Radiometric", "prb.PRB"])
def test_gains_learn_by_the_derivative_of_what_is_predicted(box, monkeypatch, method):
    """By every method; at the photographed values themselves noise would make photographs darker."""
    box()
    asked, colors = [], FittedDevelopment.colors

    def noted(self, batch, radiance=None):
        if torch.is_grad_enabled() and not batch.color.requires_grad:
            asked.append(radiance)
        return colors(self, batch, radiance)

    monkeypatch.setattr(FittedDevelopment, "colors", noted)
    objective = [] if method.startswith("radio") else ["--model.objective.prior=0", "--model.objective.lhs=0"]
    fit(
        "--data.exposure=fit",
        f"--model.method=neurad.integrators.{method}",
        "--model.lighting.emitters=photographs",
        *objective,
    )
    first = [radiance for radiance in asked if radiance is not None]
    assert len(first) >= 2  # one an iteration
    assert all(len(radiance) == 64 and bool((radiance >= 0).all()) for radiance in first)


def test_lamps_that_only_rare_paths_show_are_not_like_all_others():
    """Where the two halves of the samples have nothing in common, their correlation means nothing."""
    light = pictures(8, 3)
    halves = noisy(light)
    halves[:, 2] = 0.0
    halves[0, 2, :40], halves[1, 2, 40:80] = 9.0, 9.0  # of one lamp, on other pixels in each half
    responses = Responses(halves, None, None, np.einsum("mnc->nc", light))
    assert responses.reaches.all()
    assert indistinguishable(responses, np.zeros(3, bool)) == [[0], [1], [2]]
