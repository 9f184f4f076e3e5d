"""Large photo sets: photographs that take turns in memory, and camera rays that nobody keeps."""

import argparse
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.cameras import film
from helpers.small_step import SmallStep, small_scene
from helpers.tables import csv_rows
from helpers.tiny_scene import SIZE, ready, write_scene
from scipy import stats

from benchmarks.bench import growth
from benchmarks.bench.session import prepare
from datamodules.image_cache import SAMPLE, blurred
from datamodules.scene_data import SceneData
from neurad.assembly.build import build_world
from neurad.assembly.settings import Objective, Sampling
from neurad.cli import main
from neurad.core.camera import camera_rays
from neurad.core.errors import InputError
from neurad.core.rng import Stream
from neurad.core.scene_records import Camera
from neurad.images.image_io import read_exr, write_exr
from neurad.integrators import emitter_pixels
from neurad.integrators.film import pixel_positions
from neurad.integrators.primary_hits import PrimaryHits
from neurad.scene.builtin import build_cornell, build_cube

VIEWS = 7
CPU = torch.device("cpu")


@pytest.fixture
def folder(tmp_path):
    pytest.importorskip("mitsuba")
    return write_scene(tmp_path / "room", VIEWS)


def with_alpha(folder, empty=(2,)):
    """Random photographs, of which random pixels of the left half are covered; nothing at all in ``empty``."""
    rng = np.random.default_rng(3)
    for i in range(VIEWS):
        image = rng.random((SIZE, SIZE, 4), np.float32)
        image[..., 3] *= (np.arange(SIZE) < SIZE // 2) & (rng.random((SIZE, SIZE)) < 0.5) & (i not in empty)
        image[..., :3] *= image[..., 3:]
        write_exr(folder / f"images/train_{i}.exr", image, half=False)
    return folder


# ---- which photographs are in memory


def test_every_view_is_in_memory_equally_long_and_one_is_replaced_at_a_time(folder):
    data = ready(folder, patches=1, resident=3, replace_every=4)
    held, before = [], None
    for iteration in range(4 * VIEWS):
        data.batch(iteration)
        now = set(data._cache._slots)
        assert len(now) == 3
        if before is not None:
            assert len(now - before) == (iteration % 4 == 0)
        held += now
        before = now
    assert set(np.bincount(held)) == {4 * 3}


def test_streamed_batches_are_those_of_all_photographs_in_the_mean(folder):
    """Chi-square over the views and pixels of whole rounds; fails by chance once in 10,000."""
    streamed, whole = (ready(folder, patches=256, resident=resident, replace_every=3) for resident in (2, None))
    counts = []
    for data in (streamed, whole):
        batches = [data.batch(iteration) for iteration in range(3 * VIEWS * 6)]
        index = torch.cat([batch.view * SIZE * SIZE + batch.pixel for batch in batches])
        counts.append(torch.bincount(index, minlength=VIEWS * SIZE * SIZE).numpy())
    assert stats.chi2_contingency(np.stack(counts)).pvalue > 1e-4
    assert stats.chisquare(counts[0]).pvalue > 1e-4


def test_what_is_in_memory_is_a_function_of_seed_iteration_and_rank(folder):
    settings = {"patches": 64, "resident": 3, "replace_every": 4}
    first, jumps = ready(folder, **settings), ready(folder, **settings)
    batches = [first.batch(iteration) for iteration in range(40)]
    for iteration in (37, 3, 4, 39):  # as a continued run does
        got = jumps.batch(iteration)
        assert all(
            torch.equal(getattr(got, name), getattr(batches[iteration], name)) for name in ("view", "pixel", "color")
        )
    orders = []
    for seed, rank in ((0, 0), (1, 0), (0, 1)):
        data = ready(folder, **settings, seed=seed)
        data.batch(0, rank)
        orders.append(data._cache.order)
    assert len({tuple(order) for order in orders}) == 3
    assert all(sorted(order) == list(range(VIEWS)) for order in orders)


@pytest.mark.parametrize("resident", [VIEWS, VIEWS + 5])
def test_room_for_all_photographs_is_the_same_as_no_limit(folder, resident):
    data, whole = ready(folder, resident=resident), ready(folder)
    assert not data.streams
    for iteration in (0, 9):
        a, b = data.batch(iteration), whole.batch(iteration)
        assert torch.equal(a.view, b.view)
        assert torch.equal(a.color, b.color)


@pytest.mark.parametrize("patch_size", [1, 3])
def test_streamed_foreground(folder, patch_size):
    data = ready(with_alpha(folder), patches=200, patch_size=patch_size, resident=2, replace_every=1)
    images = torch.tensor(np.stack([read_exr(v.image).reshape(-1, 4) for v in data.scene.train]))
    seen = set()
    for iteration in range(2 * VIEWS):
        batch = data.batch(iteration)
        seen |= set(batch.view.tolist())
        if patch_size == 1:
            assert (batch.alpha > 0).all()
        else:
            assert (batch.alpha.view(200, 9) > 0).any(1).all()
        assert torch.equal(images[batch.view, batch.pixel], torch.cat((batch.color, batch.alpha[:, None]), 1))
    assert seen == set(range(VIEWS)) - {2}, "a view without foreground says nothing"


# ---- what all photographs are needed for


@pytest.mark.parametrize("alpha", [False, True])
def test_statistics_are_of_every_photograph(folder, alpha):
    if alpha:
        with_alpha(folder)
    data, whole = ready(folder, resident=2), ready(folder)
    left_out = torch.rand(VIEWS, SIZE * SIZE) < 0.3
    for mask in (None, left_out):
        stats, same = (source.dataset_stats(mask) for source in (data, whole))
        assert stats.mean_square_radiance == same.mean_square_radiance
        assert torch.equal(stats.sample.color, same.sample.color)
    counted = (whole.alpha > 0) & ~left_out if alpha else ~left_out
    assert stats.mean_square_radiance == pytest.approx(float(whole.photographs[counted].square().mean()), rel=1e-5)
    sample = stats.sample
    assert SAMPLE / 8 < len(sample.view) <= SAMPLE + VIEWS
    assert not left_out[sample.view, sample.pixel].any()
    assert torch.equal(sample.color, whole.photographs[sample.view, sample.pixel])
    assert set(sample.view.tolist()) == set(range(VIEWS)) - ({2} if alpha else set())


@pytest.mark.parametrize("alpha", [False, True])
def test_streamed_means_around_pixels_are_those_of_photographs_in_memory(folder, alpha):
    if alpha:
        with_alpha(folder)
    data, whole = ready(folder, patches=200, resident=2, replace_every=3), ready(folder)
    data.batch(0)  # a cache without means is thrown away
    data.request_blurred()
    means = blurred(whole.photographs, whole.alpha, SIZE)
    for iteration in (0, 1, 10):
        batch = data.batch(iteration)
        torch.testing.assert_close(batch.blurred, means[batch.view, batch.pixel])


BAD = {
    "NaN": (np.full((SIZE, SIZE, 3), np.nan, np.float32), r"train_4\.exr: it has pixels that are NaN or infinite"),
    "size": (np.ones((9, SIZE, 3), np.float32), r"train_4\.exr: it has 8 x 9 pixels, its camera 8 x 8"),
    "no picture": (None, r"train_4\.exr: it cannot be read"),
    "missing": ((), r"train_4\.exr: there is no such file"),
}


@pytest.mark.parametrize("case", BAD)
@pytest.mark.parametrize("counted", [False, True])
def test_a_photograph_that_goes_bad_is_named_when_its_turn_comes(folder, case, counted):
    data = ready(folder, patches=4, resident=2, replace_every=1)
    if counted:
        data.dataset_stats()
    image, said = BAD[case]
    path = folder / "images/train_4.exr"
    path.unlink()
    if image is None:
        path.write_text("x")
    elif len(image):
        write_exr(path, image, half=False)
    with pytest.raises(InputError, match=said):  # noqa: PT012
        for iteration in range(VIEWS):
            data.batch(iteration)


# ---- camera rays that nobody keeps


@pytest.mark.parametrize("positions", [2, 5])
def test_new_positions_are_uniform_in_their_pixel(positions):
    """Kolmogorov-Smirnov on both coordinates, and none twice; fails by chance once in 5000."""
    made = SmallStep(Sampling(spp=positions, cached_spp=0))
    assert made.primary.prim.numel() == 0
    batch = made.batch(600)
    si = made.primary(batch, positions, Stream(2)).si
    assert si.valid.all()
    corner = torch.stack((batch.pixel % 12, batch.pixel // 12), -1).repeat_interleave(positions, 0)
    place = film(made.scene, batch.view.repeat_interleave(positions), si.p) - corner
    for axis in (0, 1):
        assert stats.kstest(place[:, axis].numpy(), "uniform").pvalue > 1e-4
    place = place.view(600, positions, 2)
    assert abs(np.corrcoef(place[:, 0].T, place[:, 1].T)[:2, 2:]).max() < 4 / math.sqrt(600)
    assert torch.equal(made.primary(batch, positions, Stream(2)).si.p, si.p)
    assert not torch.equal(made.primary(batch, positions, Stream(3)).si.p, si.p)


@pytest.mark.parametrize("normaliser", ["prediction", "blurred"])
def test_a_step_on_new_rays_has_the_gradient_of_one_on_many_kept(normaliser):
    """Means over 24 steps of the photometric gradient's norm along the other one agree within their noise."""
    found = []
    for cached in (0, 64):
        made = SmallStep(Sampling(spp=4, samples_per_vertex=4, cached_spp=cached), Objective(normaliser=normaliser))
        batch = replace(made.batch(100), blurred=torch.full((100, 3), 0.3))
        terms = [made.step(batch, Stream(seed, 9)).materials["photometric"][1] for seed in range(24)]
        found.append(torch.stack([made.gradients(loss.surrogate)["albedo"] for loss in terms]))
    direction = found[1].mean(0) / found[1].mean(0).norm()
    along = [(g @ direction).numpy() for g in found]
    assert stats.ttest_ind(*along, equal_var=False).pvalue > 1e-3
    assert along[0].mean() > 5 * along[0].std() / math.sqrt(24), "the noise would hide any difference"


@pytest.mark.parametrize("build", [build_cube, build_cornell])
@pytest.mark.parametrize("turn", [0.0, 0.5, 2.0])
def test_pixels_that_show_an_emitter(build, turn):
    """Only pixels onto which an emitter projects are looked at; rays everywhere find no other one."""
    scene = small_scene(build, size=24)
    spin = np.eye(4)
    spin[1:3, 1:3] = [[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]]
    cameras = [replace(v.camera, to_world=np.asarray(v.camera.to_world @ spin)) for v in scene.train]
    world = build_world(scene)
    found = PrimaryHits(world, cameras, 0, 0, CPU).sees_emitter()
    cast = world.tracer.rays_cast
    every = PrimaryHits(world, cameras, emitter_pixels.POSITIONS, 0, CPU).sees_emitter()
    assert cast < (world.tracer.rays_cast - cast)
    assert found.any() or not every.any()
    assert (found != every).float().mean() < 0.01  # slivers at the edge of a lamp, met by chance
    # With the positions of the search itself there is no difference at all.
    emission = world.geometry.emission.amax(-1) > 0
    corners = world.geometry.vertices[world.geometry.faces[emission]].double()
    for index, camera in enumerate(cameras):
        pixels = torch.arange(camera.width * camera.height)
        hit = world.tracer.closest(camera_rays(camera, pixel_positions(24, pixels, 16, Stream(index)).view(-1, 2)))
        lit = (hit.valid & emission[hit.prim.clamp_min(0)]).view(-1, 16).any(-1)
        assert not (lit & ~emitter_pixels.projected(corners, camera, world.geometry.scale)).any()


def test_projections_are_cut_at_the_camera():
    camera = Camera(np.eye(4), math.pi / 2, 8, 8)

    def shown(*corners):
        return emitter_pixels.projected(torch.tensor([corners], dtype=torch.float64), camera, 1.0).view(8, 8)

    assert not shown((-1, -1, 1), (1, -1, 1), (0, 1, 2)).any(), "behind"
    small = shown((0.1, 0.1, -4), (0.2, 0.1, -4), (0.1, 0.2, -4))
    assert small[3, 4]
    assert small.sum() <= 16
    above = shown((-0.2, 1, 3), (0.2, 1, 3), (0, 1, -3))  # passes over the camera
    assert above[0].any()
    assert not above[5:].any()
    assert not emitter_pixels.projected(torch.zeros(0, 3, 3, dtype=torch.float64), camera, 1.0).any()


# ---- runs

SMALL = [f"model.{part}.grid={{levels: 2, coarsest: 4, finest: 8, log2_size: 8}}" for part in ("albedo", "radiance")]
STREAMED = ["data.patches=48", "model.sampling.cached_spp=0", "data.resident=3", *SMALL]


def fitted(steps, *words, state=None):
    options = argparse.Namespace(config=["cornell.yaml"], set=[*STREAMED, *words], device="cpu", default_config="")
    trainer, module, data = prepare(options, steps)
    trainer.fit(module, data, **({} if state is None else {"ckpt_path": state}))
    return trainer, module, data


@pytest.mark.parametrize("words", [(), ("model.objective.normaliser=blurred",)])
def test_a_streamed_run_continues_to_the_same_bits(tmp_path, monkeypatch, words):
    monkeypatch.setattr(SceneData, "replace_every", 2)
    words = (*words, "model.optimization.schedule=constant")
    trainer, _, data = fitted(5, *words)
    assert data.streams
    assert "_pixels" not in data.__dict__
    trainer.save_checkpoint(tmp_path / "a.ckpt")
    continued, straight = fitted(12, *words, state=tmp_path / "a.ckpt")[1], fitted(12, *words)[1]
    for name, value in straight.state_dict().items():
        assert torch.equal(value, continued.state_dict()[name]), name
    assert continued.rays == straight.rays


def test_growth_streams():
    parser = argparse.ArgumentParser()
    growth.add_arguments(parser)
    options = parser.parse_args(["--side", "16", "--steps", "2", "--warmup", "1", "--resident", "4", "--set", SMALL[0]])
    rows = [growth.measure(options, curve, 9) for curve in ("views", "streamed")]
    assert [(row["views"], row["in_memory"]) for row in rows] == [(9, 9), (9, 4)]
    for row in rows:
        assert set(row) == set(growth.COLUMNS)
        assert all(row[name] > 0 for name in ("ms_per_step", "cpu_ms", "needs_MiB", "peak_MiB"))


def test_growth_names_what_needs_too_much(tmp_path, capsys):
    out = tmp_path / "growth.csv"
    none = [word for name in ("triangles", "resolution", "table", "streamed") for word in (f"--{name}", "")]
    main(["bench", "growth", *none, "--views", "1000", "--memory", "4", "--out", str(out)])
    assert "views 1000 needs about 26.6 GiB" in capsys.readouterr().out
    (row,) = csv_rows(out)
    assert row["peak_MiB"] == ""
    assert float(row["needs_MiB"]) > 20000


@pytest.mark.parametrize("resident", [None, 3])
def test_candidates_come_after_the_pixels_in_turn(folder, resident):
    data = ready(folder, patches=40, resident=resident)
    data.request_candidates(0.25, 24)
    images = [read_exr(view.image) for view in data.scene.train]
    batch = data.batch(5)
    assert len(batch.view) == 30 + 10 * 24
    assert batch.candidates == 10 * 24
    for view, pixel, color in zip(batch.view.tolist(), batch.pixel.tolist(), batch.color, strict=True):
        np.testing.assert_array_equal(color.numpy(), images[view][pixel // SIZE, pixel % SIZE])
    again = data.batch(5)
    assert torch.equal(again.pixel, batch.pixel)
    assert not torch.equal(data.batch(6).pixel, batch.pixel)
    in_turn = batch.without_candidates()
    assert len(in_turn.view) == len(in_turn.color) == 30
    assert in_turn.candidates == 0
    fewer = ready(folder, patches=30, resident=resident)
    assert torch.equal(fewer.batch(5).pixel, in_turn.pixel)


def test_candidates_are_uniform(folder):
    """Chi-square over views and pixels; fails by chance once in 10,000."""
    data = ready(folder, patches=10)
    data.request_candidates(0.5, 200)
    batches = [data.batch(i) for i in range(60)]
    index = torch.cat([b.view[-b.candidates :] * SIZE * SIZE + b.pixel[-b.candidates :] for b in batches])
    counts = torch.bincount(index, minlength=VIEWS * SIZE * SIZE).numpy()
    assert stats.chisquare(counts).pvalue > 1e-4


def test_patches_have_no_candidates(folder):
    data = ready(folder, patches=4, patch_size=2)
    data.request_candidates(0.5, 24)
    assert data.batch(0).candidates == 0
    assert len(data.batch(0).view) == 16
