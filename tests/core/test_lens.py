"""Lenses against OpenCV: rays, the way back, and pictures that fold over."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.devices import on_devices

from neurad.core.camera import Cameras, camera_rays, fov_of, in_view, pixel_side, project, to_camera
from neurad.core.lens import Lens, fold, folded
from neurad.core.rng import Stream
from neurad.core.scene_records import Camera
from neurad.scene.builtin.shapes import look_at

cv2 = pytest.importorskip("cv2")

LENSES = {
    "pinhole": (Lens(), 48, 32, 51.5),
    "centred barrel": (Lens(numerator=(-0.3, 0.05)), 640, 480, 500.0),
    "off-centre barrel": (Lens(1.02, (0.55, 0.47), (-0.3, 0.05), (), (1e-3, -2e-3)), 640, 480, 500.0),
    "pincushion": (Lens(numerator=(0.2, 0.05, 0.01)), 480, 640, 400.0),
    "full": (Lens(0.98, (0.5, 0.5), (-0.3, 0.05, 0.01), (0.01, 0.02, -0.001), (1e-3, -2e-3)), 2000, 1500, 1500.0),
    "fisheye of 160 degrees": (Lens(1.0, (0.5, 0.48), (0.01, -0.005, 0.001, -1e-4), fisheye=True), 800, 800, 287.0),
    "equidistant fisheye": (Lens(fisheye=True), 600, 400, 300.0),
}


def camera_with(name: str) -> Camera:
    lens, width, height, focal = LENSES[name]
    pose = look_at((1.0, 2.0, 3.0), (0.0, 0.5, -1.0), 40.0, 8).to_world
    return Camera(pose, fov_of(focal, width), width, height, lens)


def positions(camera: Camera, count: int = 4000) -> torch.Tensor:
    return Stream(3).uniform(count, 2).double() * torch.tensor([camera.width, camera.height])


def by_opencv(camera: Camera, directions: torch.Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Film positions that OpenCV gives to unit directions in the camera's space, and which of them lie before it."""
    points = directions.double().numpy() * (1.0, -1.0, -1.0)  # its axes: y down, looking along +z
    before = points[:, 2] > 1e-3
    inner = np.array([[camera.fl_x, 0, camera.cx], [0, camera.fl_y, camera.cy], [0, 0, 1]])
    lens, none = camera.lens, np.zeros(3)
    k = (*lens.numerator, 0.0, 0.0, 0.0, 0.0)
    if lens.fisheye:
        return cv2.fisheye.projectPoints(points[before, None], none, none, inner, np.array(k[:4]))[0][:, 0], before
    coefficients = np.array([*k[:2], *lens.tangential, k[2], *(*lens.denominator, 0.0, 0.0, 0.0)[:3]])
    return cv2.projectPoints(points[before, None], none, none, inner, coefficients)[0][:, 0], before


@pytest.mark.parametrize("name", LENSES)
@pytest.mark.parametrize(("kind", "pixels"), [(torch.float64, 1e-5), (torch.float32, 1e-3)])
def test_rays_are_opencvs(name: str, kind: torch.dtype, pixels: float) -> None:
    camera = camera_with(name)
    xy = positions(camera).to(kind)
    rays = camera_rays(camera, xy)
    assert rays.d.dtype == kind
    torch.testing.assert_close(rays.d.norm(dim=-1), torch.ones(len(xy), dtype=kind))
    there, before = by_opencv(camera, rays.d.double() @ torch.as_tensor(camera.to_world[:3, :3]).double())
    assert before.mean() > 0.9
    np.testing.assert_allclose(there, xy.double().numpy()[before], atol=pixels)


@pytest.mark.parametrize("name", LENSES)
def test_a_point_on_a_ray_is_projected_to_where_the_ray_came_from(name: str) -> None:
    camera = camera_with(name)
    xy = positions(camera)
    rays = camera_rays(camera, xy)
    p = rays.o + (0.1 + 5.0 * Stream(4).uniform(len(xy), 1).double()) * rays.d
    torch.testing.assert_close(project(camera, to_camera(camera, p)), xy, atol=1e-8, rtol=0.0)
    assert bool(in_view(camera, p).all())
    assert camera.fl_x * pixel_side(camera) == pytest.approx(1.0)
    ahead = to_camera(camera, p)[:, 2] < -0.5 * (p - rays.o).norm(dim=-1)
    assert not bool(in_view(camera, (2.0 * rays.o - p)[ahead]).any()), "behind it"


@pytest.mark.parametrize("name", LENSES)
def test_what_is_not_on_the_film_is_not_in_view(name: str) -> None:
    """Directions all around: those in view come back along the ray of their film position, and no other does."""
    camera = camera_with(name)
    d = torch.nn.functional.normalize(Stream(5).uniform(20000, 3).double() - 0.5, dim=-1)
    p = torch.as_tensor(camera.to_world)[:3, 3].double() + d
    seen = in_view(camera, p)
    assert 0.01 < float(seen.double().mean()) < 0.9
    back = camera_rays(camera, project(camera, to_camera(camera, p[seen]))).d
    torch.testing.assert_close(back, d[seen], atol=1e-8, rtol=0.0)
    # By OpenCV nothing else is on the film, as far as the distortion does not fold over.
    local = d @ torch.as_tensor(camera.to_world[:3, :3]).double()
    there, before = by_opencv(camera, local)
    inside = ((there > 0) & (there < (camera.width, camera.height))).all(-1)
    angle = np.arccos(-local[before, 2].numpy())
    reach = camera.lens.reach if camera.lens.fisheye else math.atan(camera.lens.reach)
    expected = inside & (angle < reach)
    assert (seen.numpy()[before] == expected).mean() > 0.999


@on_devices
def test_rays_of_several_cameras_are_those_of_each(device: str) -> None:
    cameras = [camera_with(name) for name in LENSES] + [replace(camera_with("full"), lens=Lens(1.1, (0.4, 0.5)))]
    view = Stream(6).integers(len(cameras), 3000)
    many = Cameras.of(cameras, device)
    xy = Stream(7).uniform(3000, 2) * many.size.cpu()[view]
    rays = many.rays(view.to(device), xy.to(device)).to("cpu")
    for index, camera in enumerate(cameras):
        here = xy[view == index]
        alone = camera_rays(camera, here)
        torch.testing.assert_close(rays.d[view == index], alone.d, atol=1e-6, rtol=0.0)
        torch.testing.assert_close(rays.o[view == index], alone.o)
        p = (alone.o + 2.0 * alone.d).to(device)
        torch.testing.assert_close(project(camera, to_camera(camera, p)).cpu(), here, atol=2e-3, rtol=0.0)


@pytest.mark.parametrize("name", LENSES)
def test_the_footprint_is_the_area_between_neighbouring_rays(name: str) -> None:
    camera = camera_with(name)
    xy = positions(camera, 500)
    found = Cameras.of([camera], "cpu").footprint(torch.zeros(500, dtype=torch.int64), xy.float()).double()
    step = 1e-3
    d, right, down = (
        camera_rays(camera, xy + torch.tensor(offset)).d @ torch.as_tensor(camera.to_world[:3, :3]).double()
        for offset in ((0.0, 0.0), (step, 0.0), (0.0, step))
    )
    if not camera.lens.fisheye:  # areas on the plane at distance 1, as of a pinhole without distortion
        d, right, down = (v / -v[:, 2:] for v in (d, right, down))
    area = torch.linalg.cross(right - d, down - d).norm(dim=-1) / step**2
    torch.testing.assert_close(found, area.sqrt(), rtol=2e-3, atol=0.0)


@pytest.mark.parametrize(
    ("lens", "side", "folds"),
    [
        (Lens(numerator=(-0.3,)), 1 / 300, True),
        (Lens(numerator=(-0.3,)), 1 / 600, False),
        (Lens(numerator=(0.2,)), 1 / 100, False),
        (Lens(denominator=(-1.0,)), 1 / 100, False),  # has a pole, but grows without end before it
        (Lens(denominator=(1.0,)), 1 / 300, True),  # never reaches the corners
        (Lens(tangential=(0.3, 0.0)), 1 / 300, True),
        (Lens(tangential=(0.01, 0.01)), 1 / 300, False),
        (Lens(fisheye=True), 1 / 300, False),
        (Lens(fisheye=True), 1 / 100, True),  # beyond straight behind
        (Lens(numerator=(-0.2,), fisheye=True), 1 / 300, True),
        (Lens(1.0, (0.9, 0.5), (-0.3,)), 1 / 600, True),
    ],
)
def test_a_picture_that_folds_over_is_found(lens: Lens, side: float, folds: bool) -> None:
    place = fold(lens, side, 640, 480)
    assert (place is not None) == folds
    if place is not None:
        assert 0 <= place[0] <= 640
        assert 0 <= place[1] <= 480


@pytest.mark.parametrize(
    ("lens", "focal"),
    [
        (Lens(1.02, (0.52, 0.47), (-0.3,)), 60.0),
        (Lens(1.0, (0.5, 0.5), (-0.3,), (), (2e-3, -1e-3)), 60.0),
        (Lens(numerator=(-0.2,), fisheye=True), 60.0),
        (Lens(fisheye=True), 20.0),  # beyond straight behind
    ],
)
def test_rays_through_what_does_not_fold_are_right_where_the_rest_does(lens: Lens, focal: float) -> None:
    """Rays through the rest are there, too: finite and of unit length, for what a mask leaves out."""
    camera = Camera(np.eye(4), fov_of(focal, 128), 128, 96, lens)
    lost = folded(lens, pixel_side(camera), 128, 96)
    assert 0.01 < lost.mean() < 0.9
    rows, columns = (torch.arange(n, dtype=torch.float64) + 0.5 for n in (96, 128))
    xy = torch.stack((columns.repeat(96), rows.repeat_interleave(128)), -1)
    rays = camera_rays(camera, xy)
    torch.testing.assert_close(rays.d.norm(dim=-1), torch.ones(len(xy), dtype=torch.float64))
    kept = torch.from_numpy(~lost.ravel())
    away = project(camera, to_camera(camera, rays.o + 2.0 * rays.d)) - xy
    assert float(away[kept].abs().max()) < 1e-6
    assert bool(in_view(camera, rays.o + 2.0 * rays.d)[kept].all())
    several = Cameras.of([camera, replace(camera, lens=Lens(numerator=(-0.01,)))], "cpu")
    footprint = several.footprint(torch.zeros(len(xy), dtype=torch.int64), xy.float())
    assert bool(footprint.isfinite().all() & (footprint > 0).all())
