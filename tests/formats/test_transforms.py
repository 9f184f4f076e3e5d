"""One ``transforms.json`` in place of two: lists of names, a share held out, and poses that nerfstudio has moved."""

import json
import shutil

import numpy as np
import pytest
from helpers.tiny_fit import metrics, write_tiny_config
from helpers.tiny_scene import write_scene

from datamodules.scene_data import SceneData
from datamodules.settings import DataSettings
from neurad.cli import main
from neurad.core.errors import InputError
from neurad.formats.load import load_scene

pytest.importorskip("mitsuba")

VIEWS = 10


@pytest.fixture
def folder(tmp_path):
    """A scene folder with one camera file, its name with a space and an umlaut."""
    folder = write_scene(tmp_path / "Mein Zimmer für alles", VIEWS)
    (folder / "transforms_test.json").unlink()
    (folder / "transforms_train.json").rename(folder / "transforms.json")
    return folder


def change(folder, frame=None, **changes):
    path = folder / "transforms.json"
    described = json.loads(path.read_text())
    (described if frame is None else described["frames"][frame]).update(changes)
    path.write_text(json.dumps(described))


def names(views):
    return [view.name for view in views]


def test_every_eighth_is_held_out_and_said(folder):
    scene = load_scene(str(folder), None)
    assert names(scene.test) == ["train_0", "train_8"]
    assert len(scene.train) == VIEWS - 2
    (said,) = scene.notes
    assert "every 8th by name is, 2 of 10 (--data.hold_out 0 for none)" in said
    assert str(folder / "transforms.json") in said
    assert names(load_scene(str(folder), None, 3).test) == ["train_0", "train_3", "train_6", "train_9"]
    whole = SceneData(DataSettings(str(folder), hold_out=0)).scene
    assert (len(whole.train), whole.test, whole.notes) == (VIEWS, [], ())
    with pytest.raises(InputError, match="hold_out: 1 would hold out every photograph"):
        SceneData(DataSettings(str(folder), hold_out=1))


def test_lists_of_names_go_first(folder):
    image = "images/train_{}.exr".format
    change(folder, train_filenames=[image(i) for i in range(6)], val_filenames=[image(6)],
           test_filenames=["./images/../images/train_7", image(6)])  # fmt: skip
    scene = load_scene(str(folder), None)
    assert names(scene.train) == [f"train_{i}" for i in range(6)]
    assert names(scene.test) == ["train_6", "train_7"]
    assert "2 of 10 photographs are in none of its lists of names" in scene.notes[0]
    change(folder, train_filenames=None)
    rest = load_scene(str(folder), None)
    assert (names(rest.test), len(rest.train), rest.notes) == (["train_6", "train_7"], 8, ())


def test_two_files_go_before_one(folder):
    shutil.copy(folder / "transforms.json", folder / "transforms_train.json")
    scene = load_scene(str(folder), None)
    assert (len(scene.train), scene.test) == (VIEWS, [])
    shutil.copy(folder / "transforms.json", folder / "transforms_val.json")
    assert len(load_scene(str(folder), None).test) == VIEWS


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"applied_transform": [[1, 0], [0, 1]]}, r"applied_transform is not 4 x 4 numbers"),
        ({"applied_transform": "none"}, r"applied_transform is not 4 x 4 numbers"),
        ({"applied_transform": np.zeros((3, 4)).tolist()}, r"applied_transform is not a rotation with a scale"),
        ({"applied_transform": np.diag([1.0, 1.0, -1.0, 1.0]).tolist()}, r"applied_transform is not a rotation"),
        ({"applied_transform": np.diag([1.0, 2.0, 1.0, 1.0]).tolist()}, r"applied_transform is not a rotation"),
        ({"applied_transform": [[float("nan")] * 4] * 3}, r"applied_transform: row 1, column 1 is nan"),
        ({"applied_scale": -1}, r"applied_scale is -1, which has to be"),
        ({"applied_scale": "two"}, r"applied_scale is 'two', not a number"),
        ({"train_filenames": "images/train_0.exr"}, r"train_filenames is not a list of names"),
        ({"test_filenames": ["images/none.exr"]}, r"test_filenames has 'images/none\.exr', which is the file_path"),
        ({"train_filenames": []}, r"its train_filenames leave no photograph to learn from"),
        ({"train_filenames": ["images/train_1"], "val_filenames": ["images/train_1.exr"]}, r"both in train_filenames"),
        ({"test_filenames": [3]}, r"test_filenames is not a list of names"),
        ({"diffuse_lobe": "lambertian"}, r"diffuse_lobe is 'lambertian'; there are burley, lambert"),
        ({"diffuse_lobe": ["burley"]}, r"diffuse_lobe is \['burley'\]; there are"),
    ],
)  # fmt: skip
def test_bad_files_get_one_sentence(folder, changes, message):
    change(folder, **changes)
    with pytest.raises(InputError, match=message) as caught:
        load_scene(str(folder), None)
    assert str(folder / "transforms.json") in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_fit_without_held_out_views_says_what_its_scores_are_of(folder, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    write_tiny_config("tiny.yaml", "scene.yaml", data={"root": str(folder), "hold_out": 0, "patches": 16})
    main(["fit", "--config", "tiny.yaml", "--trainer.max_steps", "2"])
    out, err = capfd.readouterr()
    said = "no view is held out, so scores are of 8 photographs that the fit learns from"
    assert said in err
    assert said in out
    assert "Training photographs, all pixels" in out
    assert "Held-out" not in out
    (row,) = metrics()[-1:]
    assert float(row["psnr_linear"]) > 0
    assert row["albedo_psnr"] == ""
    main(["test"])
    out, _ = capfd.readouterr()
    assert said in out
    assert len(list((tmp_path / "lightning_logs/version_0/images").glob("*_render.png"))) == 8
