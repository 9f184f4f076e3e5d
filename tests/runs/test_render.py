"""``neurad render`` by every method that has an overlay."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

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
