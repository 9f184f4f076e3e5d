"""Every bad input as a user meets it: one sentence that names the file or option, exit code 2, nothing written."""

import hashlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from helpers.tiny_scene import PLY, POSE, SIZE, XML, read_json, write_json, write_scene

from neurad.cli import main
from neurad.images.image_io import write_exr

pytest.importorskip("mitsuba")

GRID = {"levels": 2, "coarsest": 4, "finest": 8, "log2_size": 8}
CONFIG = {
    "trainer": {"max_steps": 2, "accelerator": "cpu", "enable_progress_bar": False},
    "data": {"root": "room", "patches": 16},
    "model": {part: {"grid": GRID, "width": 8} for part in ("albedo", "roughness", "radiance")},
    "evaluation": {"spp": 1},
}
FIT = ["fit", "--config", "config.yaml"]


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """A folder with a scene, a config and a finished run of two iterations."""
    place = tmp_path_factory.mktemp("fitted")
    before = Path.cwd()
    os.chdir(place)
    try:
        write_scene(place / "room")
        Path("config.yaml").write_text(yaml.safe_dump(CONFIG))
        main(FIT)
    finally:
        os.chdir(before)
    return place


@pytest.fixture
def place(fitted, tmp_path, monkeypatch):
    """A copy of it to spoil, as the working folder."""
    shutil.copytree(fitted, tmp_path / "work")
    monkeypatch.chdir(tmp_path / "work")
    return tmp_path / "work"


def tree(folder):
    """Every file below a folder with its content and time of writing, every folder with its name."""
    return {
        str(path.relative_to(folder)): (
            (hashlib.sha256(path.read_bytes()).hexdigest(), path.stat().st_mtime_ns) if path.is_file() else None
        )
        for path in sorted(folder.rglob("*"))
    }


def photograph(change, name="train_1"):
    """Spoils the pixels of a photograph."""

    def spoil(folder):
        pixels = np.full((SIZE, SIZE, 3), 0.5, np.float32)
        write_exr(folder / f"room/images/{name}.exr", change(pixels), half=False)

    return spoil


def one_pixel(value):
    def change(pixels):
        pixels[3, 4, 1] = value
        return pixels

    return change


def written(name, text):
    return lambda folder: (folder / name).write_text(text)


def removed(name):
    return lambda folder: (folder / name).unlink()


def replaced(name, old, new):
    def spoil(folder):
        text = (folder / name).read_text()
        assert old in text
        (folder / name).write_text(text.replace(old, new, 1))

    return spoil


def camera(part="train", **changes):
    def spoil(folder):
        described = read_json(folder / "room", part)
        frame = described["frames"][1]
        frame.update(changes)
        described["frames"][1] = {key: value for key, value in frame.items() if value is not ...}
        write_json(folder / "room", part, described)

    return spoil


def scaled_pose():
    matrix = np.array(POSE)
    matrix[:3, :3] *= 1.1
    return matrix.tolist()


def blocked(*names):
    """Makes the import of packages fail, as if they were not installed."""

    def spoil(folder, monkeypatch):
        for name in names:
            monkeypatch.setitem(sys.modules, name, None)

    return spoil


def nothing(folder):
    pass


EMITTER = XML[XML.index("<emitter") : XML.index("</emitter>") + 10]
WIDER = ["--model.albedo.width=16"]
BAD = {
    "missing EXR": (removed("room/images/train_1.exr"), [], ["train_1.exr", "missing"]),
    "missing held-out EXR": (removed("room/images/test_1.exr"), [], ["test_1.exr", "missing"]),
    "unreadable EXR": (written("room/images/train_1.exr", "no picture"), [], ["train_1.exr", "cannot be read"]),
    "empty EXR": (written("room/images/train_1.exr", ""), [], ["train_1.exr", "cannot be read"]),
    "truncated EXR": (
        lambda folder: (folder / "room/images/train_1.exr").write_bytes(
            (folder / "room/images/train_1.exr").read_bytes()[:-100]
        ),
        [],
        ["train_1.exr"],
    ),
    "unreadable held-out EXR": (written("room/images/test_1.exr", "no picture"), [], ["test_1.exr", "cannot be read"]),
    "NaN pixels": (photograph(one_pixel(np.nan)), [], ["train_1.exr", "NaN"]),
    "NaN pixels of a held-out view": (photograph(one_pixel(np.nan), "test_1"), [], ["test_1.exr", "NaN"]),
    "infinite pixels": (photograph(one_pixel(np.inf)), [], ["train_1.exr", "infinite"]),
    "negative pixels": (photograph(one_pixel(-0.5)), [], ["train_1.exr", "negative"]),
    "another image size": (photograph(lambda p: p[: SIZE - 1]), [], ["train_1.exr", "8 x 7"]),
    "another film size": (camera(w=16), [], ["train_1.exr", "8 x 8", "camera 16 x 8", "w and h"]),
    "another number of channels": (photograph(lambda p: p[..., :1]), [], ["train_1.exr", "channels"]),
    "black photographs": (
        lambda folder: [write_exr(folder / f"room/images/train_{i}.exr", np.zeros((SIZE, SIZE, 3))) for i in range(3)],
        [], ["room", "black"]),
    "non-rigid camera": (camera(transform_matrix=scaled_pose()), [], ["transforms_train.json", "train_1", "rigid"]),
    "no camera matrix": (camera(transform_matrix=...), [], ["transforms_train.json", "train_1", "transform_matrix"]),
    "no held-out camera matrix": (
        camera("test", transform_matrix=...), [], ["transforms_test.json", "test_1", "transform_matrix"]),
    "no camera file": (removed("room/transforms_train.json"), [], ["transforms_train.json"]),
    "no scene file": (removed("room/scene.xml"), [], ["scene.xml"]),
    "a name that steers terminals": (nothing, ["--data.root=\x1b[2J" + "x" * 9999], ["x...x", "\\x1b[2J"]),
    "no scene folder": (nothing, ["--data.root=nowhere"], ["--data.root", "nowhere"]),
    "absent mesh": (removed("room/meshes/floor.ply"), [], ["floor.ply", "missing"]),
    "unreadable mesh": (written("room/meshes/floor.ply", "no mesh"), [], ["floor.ply"]),
    "empty mesh": (written("room/meshes/floor.ply", PLY.format(faces=0)), [], ["floor", "empty"]),
    "absent texture": (removed("room/textures/paint.png"), [], ["paint.png"]),
    "unreadable texture": (written("room/textures/paint.png", "no picture"), [], ["paint.png", "cannot be read"]),
    "no emitter": (replaced("room/scene.xml", EMITTER, ""), [], ["room", "no emitter"]),
    "unknown key in a config": (written("config.yaml", "modle: {seed: 1}"), [], ["config.yaml", "modle"]),
    "unknown key of a part": (
        written("config.yaml", "model: {sampling: {position: 3}}"), [], ["config.yaml", "model.sampling.position"]),
    "unknown key on the command line": (nothing, ["--model.sampling.position=3"], ["model.sampling.position"]),
    "value of another kind": (nothing, ["--data.patches=many"], ["data.patches", "many"]),
    "patch larger than the photographs": (nothing, ["--data.patch_size=64"], ["--data.patch_size", "64"]),
    "unknown config file": (nothing, ["--config=nothing.yaml"], ["nothing.yaml"]),
    "config that is no YAML": (written("more.yaml", "a: [1"), ["--config=more.yaml"], ["more.yaml"]),
    "no checkpoint": (nothing, ["--ckpt_path=nothing.ckpt"], ["nothing.ckpt"]),
    "unreadable checkpoint": (written("torn.ckpt", "torn"), ["--ckpt_path=torn.ckpt"], ["torn.ckpt"]),
    "checkpoint of another scene": (
        replaced("room/meshes/floor.ply", "-1 0 1 0 0", "-1.5 0 1 0 0"), ["--ckpt_path=last", "--trainer.max_steps=4"],
        ["--ckpt_path", "room"]),
    "checkpoint of a built-in scene": (
        nothing, ["--ckpt_path=last", "--trainer.max_steps=4", "--data.root=null", "--data.scene=kitchen"],
        ["--ckpt_path", "room", "kitchen"]),
    "checkpoint of other field sizes": (
        nothing, ["--ckpt_path=last", "--trainer.max_steps=4", *WIDER], ["--ckpt_path", "field sizes"]),
    "checkpoint of other grids": (
        nothing, ["--ckpt_path=last", "--trainer.max_steps=4", "--model.radiance.grid.levels=3"],
        ["--ckpt_path", "field sizes"]),
    "mitsuba missing": (blocked("mitsuba"), [], ["scene.xml", "pip install 'neurad[mitsuba]'"]),
    "open3d missing": (blocked("open3d"), ["--model.tracer=open3d"], ["open3d", "pip install 'neurad[open3d]'"]),
    "unknown tracer": (nothing, ["--model.tracer=optix"], ["optix", "embree"]),
    "unknown built-in scene": (nothing, ["--data.root=null", "--data.scene=ktchen"], ["ktchen", "kitchen"]),
    "folder and built-in scene": (nothing, ["--data.scene=kitchen"], ["--data.root", "--data.scene"]),
    "scene without photographs": (nothing, ["--data.root=null", "--data.scene=cube"], ["train_000", "photograph"]),
}  # fmt: skip


@pytest.mark.main
@pytest.mark.parametrize("case", BAD)
def test_a_fit_with_bad_input(place, monkeypatch, capfd, recwarn, case):
    spoil, args, said = BAD[case]
    if "monkeypatch" in spoil.__code__.co_varnames:
        spoil(place, monkeypatch)
    else:
        spoil(place)
    before = tree(place)
    sentence = fails(capfd, [*FIT, *args])
    for word in said:
        assert word in sentence
    assert tree(place) == before
    assert not [w for w in recwarn.list if not issubclass(w.category, DeprecationWarning | PendingDeprecationWarning)]


def fails(capfd, args):
    """The sentence that a command ends with."""
    capfd.readouterr()
    with pytest.raises(SystemExit) as stop:
        main(args)
    error = capfd.readouterr().err
    assert stop.value.code == 2
    assert error.startswith("neurad: error: ")
    assert error.count("\n") == 1
    assert error.endswith("\n")
    assert len(error) < 500
    return error


@pytest.mark.main
@pytest.mark.parametrize(
    ("spoil", "args", "said"),
    [
        (removed("room/images/test_1.exr"), ["test"], ["test_1.exr"]),
        (replaced("room/meshes/floor.ply", "-1 0 1 0 0", "-1.5 0 1 0 0"), ["test"], ["--ckpt_path", "room"]),
        (nothing, ["test", *WIDER], ["--ckpt_path", "field sizes"]),
        (nothing, ["render", "--scene", "ktchen", "--out", "new"], ["ktchen"]),
        (nothing, ["render", "--root", "nowhere", "--out", "new"], ["nowhere"]),
        (nothing, ["render", "--root", "room", "--out", "room"], ["--out", "train_0.exr", "--overwrite"]),
        (nothing, ["render", "--root", "room", "--out", "new", "--spp", "0"], ["--spp"]),
        (nothing, ["render", "--root", "room", "--out", "new", "--tracer", "optix"], ["optix"]),
    ],
)
def test_other_verbs_with_bad_input(place, capfd, spoil, args, said):
    spoil(place)
    before = tree(place)
    sentence = fails(capfd, args)
    for word in said:
        assert word in sentence
    assert tree(place) == before


def test_the_program_itself_says_no_more_than_the_sentence(place):
    """One of them as a process of its own: exit code and all of stderr, imports included."""
    photograph(one_pixel(np.nan))(place)
    before = tree(place)
    code = "from neurad.cli import main; main()"
    done = subprocess.run([sys.executable, "-c", code, *FIT], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith("neurad: error: ")
    assert done.stderr.count("\n") == 1
    assert "train_1.exr" in done.stderr
    assert tree(place) == before


@pytest.mark.main
def test_the_scene_itself_is_good(place):
    """What all cases above start from trains, also in continuation."""
    before = tree(place)
    main([*FIT, "--ckpt_path=last", "--trainer.max_steps=4"])
    changed = {name for name, found in tree(place).items() if before.get(name) != found}
    assert {f"lightning_logs/version_0/{name}" for name in ("metrics.csv", "checkpoints/last.ckpt")} < changed
    assert all(name.startswith("lightning_logs/version_0") for name in changed)
