"""Pictures of the viewer without a browser: their mixtures, lamps, cameras, and what is made when something moves."""

import html
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.exported import assembled

import neurad
from neurad.core.camera import camera_rays
from neurad.core.rng import Stream
from neurad.core.scene_records import EnvironmentMap, PunctualLight
from neurad.emitters.environment import Environment
from neurad.formats.edits.placement import turned_environment
from neurad.images.photographs import read_photograph
from neurad.inspect.film import DARKEST, Film, Smoother, common, mixture
from neurad.inspect.lamps import MAX_LAMPS, Lamp, LightSettings, as_photographed, lamp_renderer, lamps_of
from neurad.inspect.maps import PhotographMap, SeenMap, modes_of
from neurad.inspect.pose import pose_of
from neurad.inspect.probe import probe
from neurad.inspect.refine import Refiner, Request, ViewedRun
from neurad.inspect.still import LitStill, Look, MapStill
from neurad.integrators.film import render
from neurad.integrators.renderer import path_tracer
from neurad.metrics.seen import SeenBy
from neurad.scene.builtin import build_cornell

SIDE = 24


@pytest.fixture(scope="module")
def run(viewed_run):
    return neurad.load(viewed_run)


@pytest.fixture
def camera(run):
    return replace(run.scene.test[0].camera, width=SIDE, height=SIDE)


@pytest.fixture
def room(run):
    cameras = [view.camera for view in run.scene.train]
    seen = SeenMap(run.world, SeenBy(run.world.geometry, run.world.tracer, cameras))
    modes = modes_of(run, seen, PhotographMap(run.world, run.views))
    return ViewedRun(run, lamps_of(run.assembly), modes, seen)


class Noisy:
    """A picture of one value with noise of a known variance."""

    def __init__(self, value, deviation):
        self.value, self.deviation = value, deviation

    def __call__(self, rays, seed):
        noise = (Stream(seed).uniform(len(rays), 3) - 0.5) * math.sqrt(12)
        return self.value + self.deviation * noise


def films(camera, *pictures, count):
    made = [Film(camera, Noisy(*picture), seed) for seed, picture in enumerate(pictures)]
    for film in made:
        for _ in range(count):
            film.add()
    return made


def test_a_film_knows_its_noise_and_an_interrupted_sample_leaves_nothing(camera):
    (film,) = films(camera, (2.0, 0.6), count=9)
    assert film.count == 9
    # 1728 values of the mean, each with a relative variance of 2: known to 3.4 % (one standard deviation)
    assert float(film.variance.mean()) == pytest.approx(0.36 / 9, rel=0.17)
    assert float((film.mean - 2.0).square().mean()) == pytest.approx(0.36 / 9, rel=0.17)

    film = Film(replace(camera, width=200, height=200), Noisy(1.0, 0.1), 0)
    assert not film.add(lambda: True)
    assert film.count == 0
    assert film.add()


@pytest.mark.parametrize("scales", [(1.0, 1.0), (0.0, 1.0), (2.0, 0.3)])
def test_a_mixture_is_better_than_what_it_is_made_of(camera, scales):
    """True pictures 0.5 and 1.5; a smooth prior of their sum that is off by 0.1; samples with noise."""
    truth = 0.5 * scales[0] + 1.5 * scales[1]
    prior = torch.full((SIDE, SIDE, 3), 2.1)
    few = films(camera, (0.5, 0.3), (1.5, 0.3), count=4)
    mixed, weight = mixture(prior, few, scales)
    alone = sum(s * film.mean for s, film in zip(scales, few, strict=True))

    def error(x):
        return float((x - truth).square().mean())

    assert error(mixed) < 0.75 * error(alone)
    if scales == (1.0, 1.0):
        assert weight > 0.6
        assert error(mixed) < 0.1**2
    many = films(camera, (0.5, 0.3), (1.5, 0.3), count=400)
    mixed, weight = mixture(prior, many, scales)
    alone = sum(s * film.mean for s, film in zip(scales, many, strict=True))
    assert abs(weight) < 0.2  # v = 0.09 / 400 each, b^2 = 0.01
    assert error(mixed) < 1.1 * error(alone)


def test_a_mixture_of_what_there_is(camera):
    """A lamp without samples is in the prior already, at the brightness that most lamps have."""
    (off,) = films(camera, (0.5, 0.0), count=1)
    none = Film(camera, Noisy(1.5, 0.0), 9)
    prior = torch.full((SIDE, SIDE, 3), 2.0)
    assert torch.allclose(mixture(prior, [off, none], [0.0, 1.0])[0], torch.tensor(1.5))
    assert torch.allclose(mixture(prior, [off, none], [0.0, 0.5])[0], torch.tensor(0.75))
    assert (common([1.0, 0.0, 1.0]), common([]), common([0.2, 2.0])) == (1.0, 0.0, 2.0)


def test_smoothing_stays_on_its_surface(run, camera):
    """LightSettings that is the same all over each mesh stays as it is; noise becomes less than a fifth."""
    side = 64
    camera = replace(camera, width=side, height=side)
    points = run.surface(camera)
    albedo = torch.from_numpy(run.map("albedo", points)).view(side, side, 3).clamp_min(DARKEST)
    mesh = run.world.geometry.mesh_index[points.prim].view(side, side, 1)
    assert len(mesh.unique()) > 5
    light = (1.0 + mesh % 7).float() * torch.tensor([1.0, 0.5, 2.0])
    smoother = Smoother(run.assembly, camera)
    assert torch.allclose(smoother(albedo * light), albedo * light, rtol=1e-4)
    large = torch.stack([mesh == i for i in mesh.unique() if (mesh == i).sum() > 200]).any(0)[..., 0]
    noise = torch.randn(side, side, 3)
    left = (smoother(albedo * (light + noise)) / albedo - light)[large]
    assert float(left.square().mean()) < 0.2 * float(noise[large].square().mean())


def test_an_environment_turns_about_its_own_axis():
    pixels = np.random.default_rng(0).random((9, 16, 3), np.float32)
    tilt = np.eye(4, dtype=np.float32)
    tilt[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]  # its +Y becomes the world's +Z
    there = EnvironmentMap(pixels, tilt)
    d = torch.nn.functional.normalize(torch.randn(200, 3), dim=-1)
    c, s = math.cos(math.radians(30)), math.sin(math.radians(30))
    about_z = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    before, after = Environment(there), Environment(turned_environment(there, 30.0))
    assert torch.allclose(after.radiance(d @ about_z.T), before.radiance(d), atol=2e-4)


def test_a_pose_is_the_camera(run):
    camera = run.scene.train[3].camera
    pose = pose_of(camera)
    again = pose.camera(camera.width * camera.height)
    assert (again.width, again.height) == (camera.width, camera.height)
    xy = torch.rand(50, 2) * torch.tensor([camera.width, camera.height])
    ours, theirs = camera_rays(camera, xy), camera_rays(again, xy)
    assert torch.allclose(ours.d, theirs.d, atol=1e-5)
    assert torch.allclose(ours.o, theirs.o)
    small = pose.camera(400)
    assert small.width * small.height == pytest.approx(400, rel=0.1)
    assert small.fov_x == pytest.approx(camera.fov_x)


def test_a_still_goes_from_the_field_to_the_method(run, camera):
    own = as_photographed(lamps_of(run.assembly))
    still = LitStill(run, camera, lamps_of(run.assembly))
    look = Look(own)
    assert not still.ready(look)
    still.step(look, lambda: False)
    assert still.ready(look)
    assert "radiance field's own" in still.says(look)
    reference = run.render(camera, 400)
    first = still.radiance(own)
    while still._whole.count < 60:
        still.step(look, lambda: False)
    noise = float(np.mean((run.render(camera, 60, 3) - reference) ** 2))
    error = float(np.mean((still.radiance(own) - reference) ** 2))
    assert error < np.mean((first - reference) ** 2)
    assert error < 1.5 * noise


def test_other_light_costs_no_new_samples(run, camera):
    """Once each lamp has its picture, every brightness is a sum; a lamp that is off makes the room darker."""
    lamps = lamps_of(run.assembly)
    still = LitStill(run, camera, lamps)
    off = Look(LightSettings((0.0,) + (1.0,) * (len(lamps) - 1)))
    steps = 0
    while not still.ready(off) or min(film.count for film in still._films) < 30:
        still.step(off, lambda: False)
        steps += 1
        assert steps < 500
    own = still.radiance(as_photographed(lamps)).mean()
    dark = still.radiance(off.light).mean()
    assert dark < 0.97 * own
    counts = [film.count for film in still._films]
    for scales in ((0.5, 2.0), (3.0, 0.0), (0.0, 0.0)):
        light = LightSettings(scales + (1.0,) * (len(lamps) - 2))
        assert still.ready(Look(light))
        expected = sum(s * float(film.mean.mean()) for s, film in zip(light.scales, still._films, strict=True))
        assert float(still.radiance(light).mean()) == pytest.approx(expected, rel=0.05, abs=1e-6)
    assert [film.count for film in still._films] == counts
    reference = render(camera, lamp_renderer(run.assembly, lamps[1]), 64, 4).mean()
    if len(lamps) == 2:
        assert dark == pytest.approx(float(reference), rel=0.05)


def test_coarse_while_it_moves_and_whole_when_it_rests(run, room):
    refiner = Refiner(room)
    pose = pose_of(run.scene.test[0].camera)
    own = as_photographed(room.lamps)
    side = 96
    room.cost.update({"albedo": 1e-6})  # seconds a pixel: a whole picture takes a hundredth of a second
    request = Request(pose, "albedo", Look(own), side * side)
    first = refiner.work(request, lambda: False)
    assert first.picture.shape == (side, side, 3)
    assert not first.coarse
    moved = replace(request, pose=replace(pose, position=(pose.position[0] + 0.1, *pose.position[1:])))
    room.cost.update({"albedo": 1.0})
    frame = refiner.work(moved, lambda: False)
    assert frame.coarse
    assert frame.picture.shape == (48, 48, 3)
    for _ in range(200):
        better = refiner.work(moved, lambda: False)
        frame = better or frame
        if refiner.rests(moved):
            break
    assert refiner.rests(moved)
    assert frame.picture.shape == (side, side, 3)
    assert not frame.coarse


def test_photographs_beside_the_render(run, room):
    """At the left what the photographs' mode shows, at the right the render, and no new samples as the line moves."""
    pose, own = pose_of(run.scene.train[0].camera), as_photographed(room.lamps)
    pixels = run.scene.train[0].camera.width ** 2
    left, right, both = (Refiner(room) for _ in range(3))

    def rest(refiner, mode, share):
        request, frame = Request(pose, mode, Look(own, photographs=share), pixels), None
        while frame is None or (mode == "photograph" and not refiner.rests(request)):
            frame = refiner.work(request, lambda: False) or frame
        return frame

    whole = rest(left, "photograph", 0.0).picture
    room.cost.clear()
    room.cost.update({name: 1e-9 for name in ("render", "render split")})
    shown = rest(both, "render", 0.5)
    middle = whole.shape[1] // 2
    assert "Left: The photographs" in shown.says
    assert np.abs(shown.picture[:, : middle - 1].astype(int) - whole[:, : middle - 1]).mean() < 3
    assert np.array_equal(shown.picture[:, middle:], rest(right, "render", 0.0).picture[:, middle:])
    counts = both._still._left._film.count, both._still._right._field.count
    moved = rest(both, "render", 0.25)
    assert np.array_equal(moved.picture[:, middle:], shown.picture[:, middle:])
    assert not np.array_equal(moved.picture[:, middle // 2 : middle - 1], shown.picture[:, middle // 2 : middle - 1])
    assert (both._still._left._film.count, both._still._right._field.count) == counts


def test_every_mode_shows_something_of_its_own(run, room, viewed_run):
    """At the pose of a training view; the photograph there is the photograph."""
    view = run.scene.train[0]
    pose, own = pose_of(view.camera), as_photographed(room.lamps)
    assert set(room.modes) == {
        "photograph", "albedo", "roughness", "albedo error bars", "roughness error bars", "seen"
    }  # fmt: skip
    said = run.bars.sentence
    assert said.startswith("Roughness is determined on ")
    assert room.modes["roughness error bars"].says.endswith(said)
    assert said in html.unescape((viewed_run / "report.html").read_text())
    shown = {}
    for mode in room.modes:
        refiner = Refiner(room)
        request = Request(pose, mode, Look(own), view.camera.width * view.camera.height)
        while not refiner.rests(request):
            shown[mode] = refiner.work(request, lambda: False) or shown.get(mode)
        assert shown[mode].picture.std() > 0.3, mode  # a fit of a moment has hardly found any roughness
        assert shown[mode].says == room.modes[mode].says
    values = [frame.picture.astype(int) for frame in shown.values()]
    for i, a in enumerate(values):
        for b in values[:i]:
            assert np.abs(a - b).mean() > 1
    own_photograph = room.modes["photograph"].integrator
    xy = torch.tensor([[x + 0.5, y + 0.5] for y in range(0, 128, 3) for x in range(0, 128, 3)])
    seen = own_photograph(camera_rays(view.camera, xy), 0).numpy()
    photograph = read_photograph(view.image)[::3, ::3].reshape(-1, 3)
    there = seen[:, 3] == 1
    assert there.mean() > 0.98
    assert np.median(np.abs(seen[there, :3] - photograph[there])) < 0.01 * photograph.mean()


def test_a_point_is_read_out(run, room):
    """What the pixel in the middle of a view shows, as the arrays of the whole view say it."""
    view = run.scene.test[1]
    points = run.surface(view)
    lane = 128 * 64 + 64
    eye = view.camera.to_world[:3, 3]
    reading = probe(run, room.seen, eye, points.p[lane].numpy() - eye)
    assert reading.position == pytest.approx(points.p[lane].numpy(), abs=1e-3)
    for name in run.maps:
        assert reading.values[name] == pytest.approx(run.map(name, points)[lane], abs=1e-3)
    assert reading.stds["albedo"] == pytest.approx(run.map_std("albedo", points)[lane], rel=0.05)
    assert reading.mesh == run.scene.meshes[int(run.world.geometry.mesh_index[points.prim[lane]])].name
    assert (len(reading.photographs) > 0) == bool(run.seen(points)[lane])
    assert len(reading.photographs) == int(room.seen.count(points[lane : lane + 1]))
    words = dict(reading.lines())
    assert dict(reading.place_lines())["mesh"] == reading.mesh
    assert words["photographs"].endswith(reading.photographs[-1] if len(reading.photographs) <= 8 else "others")
    assert f"{reading.values['roughness'][0]:.3f} ± {reading.stds['roughness'][0]:.3f}" == words["roughness"]
    assert probe(run, room.seen, np.array([0.0, 1e4, 0.0]), np.array([0.0, 1.0, 0.0])) is None


# ---- lights without extent in the viewer: a slider each, and pictures of each alone that sum up to all of them


def bulb(name, intensity, x=0.0):
    return PunctualLight(name, "point", np.full(3, intensity, np.float32), np.float32([x, 0.5, 0.2]))


def test_every_lamp_alone_sums_up_to_all():
    scene = replace(build_cornell(), punctual=(bulb("dim", 0.3, -0.5), bulb("bright", 3.0, 0.4)), max_depth=3)
    parts = assembled(scene)
    lamps = lamps_of(parts)
    assert {lamp.name for lamp in lamps} == {"light", "dim", "bright"}
    assert [lamp.name for lamp in lamps].index("bright") < [lamp.name for lamp in lamps].index("dim")
    camera = replace(scene.test[0].camera, width=8, height=8)
    alone = [render(camera, lamp_renderer(parts, lamp), 64, 3).mean() for lamp in lamps]
    whole = render(camera, path_tracer(parts.world, parts.materials, 3, 8), 128, 4).mean()
    assert float(sum(alone)) == pytest.approx(float(whole), rel=0.03)
    assert all(float(part) > 0.01 * float(whole) for part in alone)


def test_dim_ones_beyond_the_sliders_share_one():
    many = tuple(bulb(f"bulb {i}", 1.0 + i) for i in range(MAX_LAMPS + 3))
    lamps = lamps_of(assembled(replace(build_cornell(), punctual=many)))
    assert len(lamps) == MAX_LAMPS
    assert lamps[-1].name == "5 other lamps"
    assert sum(len(lamp.meshes) for lamp in lamps) == 1
    assert sorted(i for lamp in lamps for i in lamp.punctual) == list(range(MAX_LAMPS + 3))
    assert Lamp("environment").is_environment
    assert not any(lamp.is_environment for lamp in lamps)


@pytest.mark.parametrize("mode", ["photograph", "seen"])
def test_while_it_moves_few_lanes_are_looked_up_and_hardly_any_differs(run, room, mode, monkeypatch):
    """What neighbours share they share by surface: pixels beside an edge keep their own."""
    camera = replace(run.scene.test[0].camera, width=128, height=128)
    asked = []
    at = SeenBy.at
    monkeypatch.setattr(SeenBy, "at", lambda self, index, p: asked.append(len(p)) or at(self, index, p))
    pictures, lanes = [], []
    for moves in (False, True):
        asked.clear()
        still, look = MapStill(camera, room.modes[mode], None, moves=moves), Look(as_photographed(room.lamps))
        still.step(look, lambda: False)
        pictures.append(still.picture(look).astype(int))
        lanes.append(sum(asked))
    assert lanes[1] < 0.5 * lanes[0]
    assert np.abs(pictures[0] - pictures[1]).mean() < 4
