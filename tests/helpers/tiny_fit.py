"""Fits of the built-in Cornell box that take a second: fields of a few cells, a few pixels a step."""

import contextlib
import io
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import yaml

from helpers.tables import csv_rows
from helpers.tiny_scene import write_scene
from neurad.cli import main
from neurad.scene import builtin

GRID = {"levels": 2, "coarsest": 4, "finest": 8, "log2_size": 8}
TINY = {
    "trainer": {"accelerator": "cpu", "enable_progress_bar": False, "max_time": None},
    "data": {"patches": 16},
    "model": {
        **{part: {"grid": GRID, "width": 8} for part in ("albedo", "roughness", "radiance")},
        "sampling": {"spp": 4, "cached_spp": 4},
    },
    "evaluation": {"every_n_steps": 1000, "spp": 1, "test_spp": 1},
}


def write_tiny_config(path="tiny.yaml", base="cornell.yaml", **parts):
    """A config of tiny sizes on top of a shipped one; ``parts`` overlay its top-level keys."""
    merged = {key: {**TINY.get(key, {}), **parts.get(key, {})} for key in TINY.keys() | parts.keys()}
    Path(path).write_text(yaml.safe_dump({"base": base, **merged}))


def few_views(patch, name, train=5):
    """The first views of the built-in room ``name`` alone, whose fit takes a fraction of the time."""
    scene = builtin.build(name)
    few = replace(scene, train=scene.train[:train], test=scene.test[:1])
    patch.setitem(builtin._BUILDERS, name, lambda: few)


def fit(*args):
    main(["fit", "--config", "tiny.yaml", *args])


def finished_run(folder, base):
    """A new folder with a run of two iterations; of a scene folder ``room`` where the base is ``scene.yaml``."""
    folder.mkdir()
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        few_views(patch, "cornell", 3)
        data = {}
        if base == "scene.yaml":
            write_scene(Path("room"))
            data = {"root": "room"}
        write_tiny_config(base=base, data=data)
        fit("--trainer.max_steps=2", "--model.lighting.lamp_mismatch=warn")  # photographs of noise
    return folder


def run_folder(version=0):
    return Path("lightning_logs") / f"version_{version}"


def metrics(version=0):
    """Rows of a run's ``metrics.csv`` without the column that measures time."""
    return [
        {k: v for k, v in row.items() if "seconds" not in k} for row in csv_rows(run_folder(version) / "metrics.csv")
    ]


def config(version=0):
    return yaml.safe_load((run_folder(version) / "config.yaml").read_text())


def checkpoint(version=0):
    return torch.load(run_folder(version) / "checkpoints" / "last.ckpt", weights_only=True)


def printed_config(*args):
    """The resolved settings of a fit that is only printed."""
    with contextlib.redirect_stdout(io.StringIO()) as out, pytest.raises(SystemExit) as stop:
        main(["fit", *args, "--print_config"])
    assert stop.value.code == 0, args
    return yaml.safe_load(out.getvalue())


def leaves(tree, above=""):
    """Settings of a tree by their dotted names."""
    found = {}
    for key, value in tree.items():
        found |= leaves(value, f"{above}{key}.") if isinstance(value, dict) else {above + key: value}
    return found


def fails(capfd, *args, alone=True, leaves=False):
    """The sentence that a command ends with, exit code 2; it says nothing else if that is ``alone``, and nothing is new
    or gone below the working folder unless it ``leaves`` something.
    """
    before = there()
    capfd.readouterr()
    with pytest.raises(SystemExit) as stop:
        main([str(word) for word in args])
    error = capfd.readouterr().err.strip()
    error = error if alone else error.splitlines()[-1]
    assert stop.value.code == 2
    assert error.startswith("neurad: error: ")
    assert "\n" not in error
    assert leaves or there() == before
    return error


def there():
    """What lies below the working folder; the checkout is not looked at, as other tests work in it, too."""
    if Path("pyproject.toml").is_file():
        return set()
    return {path for path in Path().rglob("*") if "__pycache__" not in path.parts}


def tree(folder):
    """Every file below a folder, with its time of writing and its size."""
    files = ((path, path.stat()) for path in Path(folder).rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): (about.st_mtime_ns, about.st_size) for path, about in files}
