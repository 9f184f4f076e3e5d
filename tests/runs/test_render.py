"""``neurad render`` by every method that has an overlay."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml
from helpers import layouts
from helpers.tiny_fit import fails

from neurad.cli import main
from neurad.images.image_io import read_exr

SMALL = ("--scene", "cornell", "--views", "test", "--spp", "16", "--map-spp", "1", "--size", "12", "--steps", "3")
OVERLAYS = sorted((Path(__file__).parents[2] / "configs" / "methods").glob("*.yaml"))


def picture(out: Path, *arguments: str) -> np.ndarray:
    """The first held-out view by some options."""
    main(["render", *SMALL, "--out", str(out), *arguments])
    return np.asarray(read_exr(out / "images" / "test_000.exr"))


@pytest.mark.parametrize("overlay", OVERLAYS, ids=lambda path: path.stem)
def test_every_method_with_an_overlay_renders(tmp_path: Path, overlay: Path) -> None:
    method = yaml.safe_load(overlay.read_text())["model"]["method"]["class_path"]
    image = picture(tmp_path, "--integrator", method.split(".")[-2])
    assert image.shape[:2] == (12, 12)
    assert bool(np.isfinite(image).all())
    assert image.mean() > 0.01
    reads_field = any(name in method for name in ("radiometric", "debiased", "blend"))
    assert (tmp_path / "images_lhs").exists() == reads_field


def test_replay_renders_what_path_tracing_does_and_direct_light_is_depth_two(tmp_path: Path) -> None:
    path = picture(tmp_path / "path")
    assert np.array_equal(path, picture(tmp_path / "prb", "--integrator", "prb"))
    short = picture(tmp_path / "short", "--max-depth", "2")
    np.testing.assert_allclose(picture(tmp_path / "direct", "--integrator", "direct"), short, rtol=1e-5, atol=1e-6)
    emitters = picture(tmp_path / "one", "--max-depth", "1")
    assert emitters.mean() < short.mean() < path.mean()


# ---- a scene folder makes the photographs: rendering asks for none, nor for masks and maps


pytest.importorskip("mitsuba")


@pytest.fixture
def room(place):
    """A scene folder whose file says nothing of what is held out, with a mask, true maps and an exposure."""
    source = layouts.write_nerfstudio(place / "src", layouts.cameras(count=9))
    main(["data", "nerfstudio", str(source), "--mesh", str(layouts.write_mesh(place / "mesh")), "--out", "room"])
    path = place / "room/transforms.json"
    described = json.loads(path.read_text())
    for frame in described["frames"]:
        frame["exposure"] = 2.0
    path.write_text(json.dumps(described))
    return path


def pictures(out):
    main(["render", "--root", "room", "--out", out, "--spp", "2", "--map-spp", "1"])


def test_the_same_pictures_with_and_without(room):
    pictures("with")
    described = json.loads(room.read_text())
    described["frames"][2] |= {"mask_path": "masks/none.png", "albedo_path": "albedo/none.exr"}
    room.write_text(json.dumps(described))
    shutil.rmtree("room/images")
    pictures("without")
    files = sorted(path.relative_to("with") for path in Path("with").rglob("*.*"))
    assert len(files) == 3 * 9 + 2  # every 8th by name is held out, as with photographs
    for file in files:
        assert Path("with", file).read_bytes() == Path("without", file).read_bytes()
    assert "exposure" not in Path("with/transforms_train.json").read_text()  # pictures have radiance


@pytest.mark.parametrize("name", ["r_0", "r_0.png", "./train/r_0", "r.0"])
def test_cameras_that_say_an_angle_alone(room, name):
    """As NeRF's own data: no size, and names without an ending."""
    pose = json.loads(room.read_text())["frames"][0]["transform_matrix"]
    described = {"camera_angle_x": 0.9, "frames": [{"file_path": name, "transform_matrix": pose}]}
    room.write_text(json.dumps(described))
    main(["render", "--root", "room", "--out", "out", "--spp", "1", "--map-spp", "1", "--size", "8"])
    picture = read_exr(f"out/images/{name.rpartition('/')[2].removesuffix('.png')}.exr")
    assert picture.shape == (8, 8, 3)
    assert np.isfinite(picture).all()


def test_a_focal_length_in_pixels_needs_their_number(room, capfd):
    described = json.loads(room.read_text())
    for key in ("w", "h"):
        described.pop(key, None)
        for frame in described["frames"]:
            frame.pop(key, None)
    room.write_text(json.dumps(described))
    shutil.rmtree("room/images")
    error = fails(capfd, "render", "--root", "room", "--out", "out")
    assert "frame 0 (images/frame_00000.exr): neither w and h nor a photograph says how many pixels" in error
