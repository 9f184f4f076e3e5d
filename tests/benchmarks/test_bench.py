"""The benchmarks: their bookkeeping, and that each of them runs and writes its table."""

import argparse
import json
import subprocess
import sys
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from helpers.clients import blender_python, cache_folder
from helpers.tables import csv_rows

from benchmarks.bench import growth, stages, start
from benchmarks.loaded import load_mitsuba
from benchmarks.rooms import one_roughness, scanned
from neurad.cli import main
from neurad.core.errors import InputError
from neurad.fields.hash_grid import HashGrid
from neurad.formats.load import read_folder
from neurad.images.image_io import read_exr, write_exr, write_png
from neurad.images.photographs import read_view

SMALL = [
    "--config", "cornell.yaml", "--set", "data.patches=64", "--set", "model.sampling.spp=2",
    "--set", "model.sampling.cached_spp=2",
]  # fmt: skip


def test_step_has_every_stage_and_puts_the_library_back(tmp_path, capsys):
    out = tmp_path / "step.csv"
    forward, backward = HashGrid.forward, stages.mlp._Layers.backward
    glossy = ["--config", "patterns.yaml", *SMALL[2:]]  # a Lambertian scene leaves stages out
    main(["bench", "step", *glossy, "--steps", "3", "--warmup", "2", "--out", str(out)])
    assert "ms a step" in capsys.readouterr().out
    rows = {row["stage"]: row for row in csv_rows(out)}
    whole = float(rows.pop("whole step, no stopwatch")["ms"])
    assert set(stages.STAGES) <= set(rows)
    for stage in stages.STAGES:
        assert float(rows[stage]["ms"]) > 0, stage
    assert sum(float(rows[stage]["percent"]) for stage in rows) == pytest.approx(100.0)
    assert whole > 0
    assert HashGrid.forward is forward
    assert stages.mlp._Layers.backward is backward


def test_growth_measures_what_has_grown():
    parser = argparse.ArgumentParser()
    growth.add_arguments(parser)
    options = parser.parse_args(["--side", "16", "--steps", "2", "--warmup", "1", *SMALL])
    row = growth.measure(options, "triangles", 500)
    assert row["triangles"] == pytest.approx(500, rel=0.1)
    assert row["pixels"] == 256
    assert row["ms_per_step"] > 0
    assert row["setup_s"] > 0


SETTINGS = ["--config=cornell.yaml", "--data.patches=64", "--model.sampling.spp=2", "--model.sampling.cached_spp=2"]


def test_parts_of_a_start_add_up():
    *parts, whole = start.start(SETTINGS, cold=False)
    assert len(parts) == len(start.PARTS)
    for key in ("seconds", "processor_s"):
        assert all(part[key] > 0 for part in parts)
        assert sum(part[key] for part in parts) == pytest.approx(whole[key])


# ---- the rooms whose roughness is one number a material: what their scripts write


def room(folder, maps):
    """A floor of a square, its material by a reference, below a lamp, seen by two cameras of 8 x 8 pixels.

    Args:
        folder: to write.
        maps: a number between 0 and 255 for each material that has a map; the first one is the floor's.
    """
    (folder / "textures").mkdir(parents=True)
    bsdfs = ""
    for index, value in enumerate(maps):
        write_png(folder / f"textures/{index}.png", np.full((4, 4, 3), value, np.uint8))
        bsdfs += f"""<bsdf type="twosided" id="m{index}"><bsdf type="principled">
            <rgb name="base_color" value="0.2, 0.4, 0.6"/><texture type="bitmap" name="roughness">
            <string name="filename" value="textures/{index}.png"/><boolean name="raw" value="true"/></texture>
            </bsdf></bsdf>"""
    (folder / "scene.xml").write_text(f"""<scene version="3.0.0"><integrator type="path"/>
        {bsdfs}<shape type="rectangle"><ref id="m0"/></shape>
        <shape type="rectangle"><transform name="to_world"><rotate x="1" angle="180"/><translate z="3"/></transform>
        <emitter type="area"><rgb name="radiance" value="1, 1, 1"/></emitter></shape></scene>""")
    pose = np.eye(4)
    pose[2, 3] = 0.5  # it looks down from there
    for split in ("train", "test"):
        paths = {"file_path": "images", "albedo_path": "albedo", "roughness_path": "roughness"}
        frame = {key: f"{kind}/{split}.exr" for key, kind in paths.items()}
        cameras = {"camera_angle_x": 1.2, "w": 8, "h": 8, "fl_x": 5.847, "fl_y": 5.847, "cx": 4.0, "cy": 4.0}
        cameras["frames"] = [{**frame, "transform_matrix": pose.tolist()}]
        (folder / f"transforms_{split}.json").write_text(json.dumps(cameras))
    return folder


def numbers(folder):
    """The roughness of each material of a scene.xml."""
    scene = ET.parse(folder / "scene.xml").getroot()
    return {
        b.attrib["id"]: float(b.find("bsdf/float[@name='roughness']").attrib["value"]) for b in scene.findall("bsdf")
    }


def test_a_map_becomes_its_mean(tmp_path):
    one_roughness.copy_room(room(tmp_path / "a", [51, 204, 255]), tmp_path / "b", 1)
    assert numbers(tmp_path / "b") == pytest.approx({"m0": 0.2, "m1": 0.8, "m2": 0.9})
    assert not list((tmp_path / "b/textures").iterdir())
    one_roughness.copy_room(tmp_path / "b", tmp_path / "c", 1, every=True)
    drawn = numbers(tmp_path / "c")
    assert len(set(drawn.values())) == 3
    assert drawn != numbers(tmp_path / "b")


def test_the_room_is_photographed_and_has_true_maps(tmp_path):
    """The lamp's edges seen from the floor's middle give the irradiance there, of a closed form."""
    try:
        load_mitsuba()
    except InputError as error:
        pytest.skip(str(error))
    source = room(tmp_path / "a", [51])
    one_roughness.copy_room(source, tmp_path / "b", 1, size=4)
    one_roughness.photograph(tmp_path / "b", 16, 1)
    for split in ("train", "test"):
        roughness, albedo, picture = (
            read_exr(tmp_path / f"b/{kind}/{split}.exr") for kind in ("roughness", "albedo", "images")
        )
        assert picture.shape == albedo.shape == (4, 4, 3)
        np.testing.assert_allclose(roughness, 0.2, atol=1e-3)
        np.testing.assert_allclose(albedo, np.broadcast_to([0.2, 0.4, 0.6], albedo.shape), atol=1e-3)
        side = 1.0 / np.hypot(1.0, 3.0)
        form = 4.0 / np.pi * side * np.arctan(side)  # of a square of side 2 seen from 3 below its middle
        middle = picture[1:3, 1:3].mean((0, 1))
        assert middle[2] - middle[0] == pytest.approx(0.4 * form, rel=0.15)  # the highlight has no colour
    before = (tmp_path / "b/images/train.exr").stat().st_mtime_ns
    one_roughness.photograph(tmp_path / "b", 16, 1)
    assert (tmp_path / "b/images/train.exr").stat().st_mtime_ns == before


def test_a_scan_is_one_mesh_with_cameras_a_little_off(tmp_path):
    """Held-out views stay where they are, with photographs in the exposure of the others and true maps."""
    pytest.importorskip("open3d")
    source = room(tmp_path / "a", [51])
    for split, level in (("train", 0.4), ("test", 0.2)):
        for kind in ("images", "albedo", "roughness"):
            (source / kind).mkdir(exist_ok=True)
            write_exr(source / f"{kind}/{split}.exr", np.full((8, 8, 3), level, np.float32))
    before = read_folder(source)
    scanned.scan_room(source, tmp_path / "b", seed=0)
    scene = read_folder(tmp_path / "b")
    (mesh,) = scene.meshes
    assert mesh.radiance is None
    assert np.ptp(mesh.vertices[:, 2]) == pytest.approx(3.0, abs=0.02)
    (train,), (test,) = scene.train, scene.test
    np.testing.assert_array_equal(test.camera.to_world, before.test[0].camera.to_world)
    np.testing.assert_allclose(read_exr(test.maps["albedo"]), 0.2, rtol=1e-3)
    assert 1e-3 < np.abs(train.camera.to_world - before.train[0].camera.to_world).max() < 0.02
    assert read_view(train).mean() == pytest.approx(2.0 * read_view(test).mean(), rel=0.05)


@pytest.mark.slow
def test_a_furnished_room_is_modelled_and_photographed(request, tmp_path):
    """Many materials of one roughness each, above 0.5 on half of the surface; true maps of all views, and a split."""
    python = blender_python(cache_folder(request, "blender"))
    words = ["--blender", python, "--views", "2", "1", "--size", "32", "24", "--samples", "4"]
    subprocess.run([sys.executable, "-m", "benchmarks.rooms.blender_room", str(tmp_path / "room"), *words], check=True)
    scene = read_folder(tmp_path / "room").check()
    assert [view.name for view in scene.train + scene.test] == ["train_000", "train_001", "test_000"]
    area, rough = [], []
    for mesh in scene.meshes:
        material = scene.materials[mesh.material]
        if mesh.radiance is None and not material.model.is_delta:
            corners = mesh.vertices[mesh.faces].astype(np.float64)
            sides = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            area.append(np.linalg.norm(sides, axis=1).sum())
            rough.append(float(material.roughness.value[0]))  # a number: none has a map
    area, rough = np.array(area) / np.sum(area), np.array(rough)
    assert len(scene.meshes) > 100
    assert len(set(rough)) >= 20
    assert area[rough > 0.5].sum() > 0.5
    assert (area * (rough - area @ rough) ** 2).sum() < 0.2**2
    for view in scene.train + scene.test:
        picture, albedo, found = (read_exr(path) for path in (view.image, view.maps["albedo"], view.maps["roughness"]))
        assert picture.shape == albedo.shape == (24, 32, 3)
        assert np.median(picture) > 0.05
        assert 0.4 < found.mean() < 0.9
