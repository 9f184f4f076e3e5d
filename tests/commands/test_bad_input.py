"""Every bad input as a user meets it: one sentence that names the file or option, exit code 2, nothing written."""

import gc
import hashlib
import subprocess
import sys

import numpy as np
import pytest
from helpers.spoil import as_floor, nothing, photograph, removed, replaced, written
from helpers.tiny_fit import fails
from helpers.tiny_scene import XML

from neurad.cli import main

pytest.importorskip("mitsuba")

FIT = ["fit", "--config", "tiny.yaml", "--trainer.max_steps=2", "--model.lighting.lamp_mismatch=warn"]


def tree(folder):
    """Every file below a folder with its content and time of writing, every folder with its name."""
    return {
        str(path.relative_to(folder)): (
            (hashlib.sha256(path.read_bytes()).hexdigest(), path.stat().st_mtime_ns) if path.is_file() else None
        )
        for path in sorted(folder.rglob("*"))
    }


def in_room(spoil):
    """A change of the scene folder."""
    return lambda folder: spoil(folder / "room")


def blocked(*names):
    """Makes the import of packages fail, as if they were not installed."""

    def spoil(folder, monkeypatch):
        for name in names:
            monkeypatch.setitem(sys.modules, name, None)

    return spoil


EMITTER = XML[XML.index("<emitter") : XML.index("</emitter>") + 10]
MOVED = replaced("room/meshes/floor.ply", "-1 0 1 0 0", "-1.5 0 1 0 0")
WIDER = ["--model.albedo.width=16"]
GO_ON = ["--ckpt_path=last", "--trainer.max_steps=4"]
BAD = {
    "NaN pixels of a held-out view": (in_room(photograph(np.nan, "test_1")), [], ["test_1.exr", "NaN"]),
    "no emitter": (replaced("room/scene.xml", EMITTER, ""), [], ["room", "no emitter"]),
    "a name that steers terminals": (nothing, ["--data.root=\x1b[2J" + "x" * 9999], ["x...x", "\\x1b[2J"]),
    "unknown key of a part": (
        written("tiny.yaml", "model: {sampling: {position: 3}}"), [], ["tiny.yaml", "model.sampling.position"]),
    "patch larger than the photographs": (nothing, ["--data.patch_size=64"], ["--data.patch_size", "64"]),
    "checkpoint of another scene": (MOVED, GO_ON, ["--ckpt_path", "room"]),
    "checkpoint of other field sizes": (nothing, [*GO_ON, *WIDER], ["--ckpt_path", "field sizes"]),
    "checkpoint of a field with other inputs": (  # as many numbers, so that weights have the same shapes
        nothing, [*GO_ON, "--model.radiance.inputs=[normal, direction, albedo]"],
        ["--ckpt_path: ", "['direction', 'normal', 'albedo']", "['normal', 'direction', 'albedo']"]),
    "mitsuba missing": (blocked("mitsuba"), [], ["scene.xml", "pip install 'neurad[mitsuba]'"]),
    "open3d missing": (blocked("open3d"), ["--model.tracer=open3d"], ["open3d", "pip install 'neurad[open3d]'"]),
    "folder and built-in scene": (nothing, ["--data.scene=kitchen"], ["(data.root)", "(data.scene)"]),
    "scene without photographs": (nothing, ["--data.root=null", "--data.scene=cube"], ["train_000", "photograph"]),
    "test without a photograph": (removed("room/images/test_1.exr"), ["test"], ["test_1.exr"]),
    "render onto photographs": (
        nothing, ["render", "--root", "room", "--out", "room"], ["--out", "train_0.exr", "--overwrite"]),
    "render by no tracer": (nothing, ["render", "--root", "room", "--out", "new", "--tracer", "optix"], ["optix"]),
}  # fmt: skip
"""Words follow those of a fit, or begin with another verb. What is wrong with a scene itself has its own table, in
tests/formats/test_refused_folders.py.
"""


@pytest.mark.parametrize("case", BAD)
def test_bad_input(fitted_room, monkeypatch, capfd, recwarn, case):
    spoil, args, said = BAD[case]
    if "monkeypatch" in spoil.__code__.co_varnames:
        spoil(fitted_room, monkeypatch)
    else:
        spoil(fitted_room)
    gc.collect()  # what earlier tests left open is no warning of this one
    recwarn.clear()
    before = tree(fitted_room)
    sentence = fails(capfd, *(() if args and args[0].isalpha() else FIT), *args)
    assert len(sentence) < 500
    for word in said:
        assert word in sentence
    assert tree(fitted_room) == before
    assert not [
        str(w.message)
        for w in recwarn.list
        if not issubclass(w.category, DeprecationWarning | PendingDeprecationWarning)
    ]


def test_the_program_itself_says_no_more_than_the_sentence(fitted_room):
    """One of them as a process of its own: exit code and all of stderr, imports included."""
    photograph(np.nan)(fitted_room / "room")
    before = tree(fitted_room)
    code = "from neurad.cli import main; main()"
    done = subprocess.run([sys.executable, "-c", code, *FIT], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith("neurad: error: ")
    assert done.stderr.count("\n") == 1
    assert "train_1.exr" in done.stderr
    assert tree(fitted_room) == before


def test_the_scene_itself_is_good(fitted_room):
    """What all cases above start from trains, also in continuation."""
    before = tree(fitted_room)
    main([*FIT, "--ckpt_path=last", "--trainer.max_steps=4"])
    changed = {name for name, found in tree(fitted_room).items() if before.get(name) != found}
    assert {f"lightning_logs/version_0/{name}" for name in ("metrics.csv", "checkpoints/last.ckpt")} < changed
    assert all(name.startswith("lightning_logs/version_0") for name in changed)


def test_a_fit_names_what_it_replaces_and_what_is_known_has_to_be_rendered(fitted_room, capfd):
    as_floor('<bsdf type="phong" id="shelf"/>')(fitted_room / "room")
    main(FIT)
    assert "neurad: to be recovered as principled: shelf (phong)\n" in capfd.readouterr().err
    for words in (["render", "--root", "room", "--out", "out", "--spp", "2"], [*FIT, "--model.materials=known"]):
        assert "bsdf shelf of shape floor has type phong" in fails(capfd, *words)
