"""Mutations of a run folder: its checkpoint, config and table."""

import io
import os
import pickle
import shutil
import zipfile
from collections import OrderedDict
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import torch

from helpers.fuzzing.odd import FLOATS, INTEGERS, WORDS, change, containers, pick
from helpers.fuzzing.spoil_bytes import GENERAL, write_files

OTHERS = (
    None, 0, -1, 1.5, float("nan"), float("inf"), "", "abc", [], {}, [1, 2], {"a": 1}, True, 2**70, torch.zeros(3),
    torch.zeros(0), torch.full((2, 2), float("nan")), (1, 2), b"x", {"state": []}, OrderedDict(a=1),
    torch.zeros(3, dtype=torch.int64), "a" * 70000,
)  # fmt: skip


def entry(content: Any, i: int, j: int, k: int) -> Any:
    """An entry is another thing, or is not there, or there is one more."""
    change(content, i, k, pick(OTHERS, j), (*WORDS, 5, None, "neurad", "state_dict"))
    return content


def weights(content: Any, i: int, j: int, k: int) -> Any:
    """A tensor of other values, another size or another kind."""
    holders = [inside for _, inside in containers(content) if isinstance(inside, dict)]
    tensors = [(inside, key) for inside in holders for key, x in inside.items() if isinstance(x, torch.Tensor)]
    if tensors:
        inside, key = pick(tensors, i)
        old = inside[key]
        if old.is_complex():  # changed already
            return content
        odd = torch.full_like(old, pick(FLOATS if old.is_floating_point() else INTEGERS, j))
        some = old.clone()
        if some.numel():
            some.view(-1)[i % some.numel()] = odd.view(-1)[0]
        others = (old.double(), old.flatten()[:0], old.unsqueeze(0), old.to(torch.complex64), old.bool(), old.half())
        inside[key] = pick((odd, some, some, *others), k)
    return content


def saved(content: Any) -> bytes:
    """As a checkpoint, with the checksum of its bytes."""
    file = io.BytesIO()
    torch.save(content, file)
    return sealed(file.getvalue())


def sealed(data: bytes) -> bytes:
    """Bytes with a correct checksum, whatever they are: what reads them has to see for itself."""
    from neurad.checkpoints.file import Sealer

    with TemporaryFile() as file:
        sealer = Sealer(file.fileno())
        sealer.write(data)
        sealer.seal()
        file.seek(0)
        return file.read()


class _Evil:
    """Would make a folder if it were loaded as an object."""

    def __reduce__(self):
        return os.mkdir, ("executed",)


def other(data: bytes, i: int, j: int, k: int) -> bytes:
    file = io.BytesIO()
    name = pick(("data.pkl", "archive/data.pkl", "x", "../x", "archive/version"), i)
    with zipfile.ZipFile(file, "w") as made:
        made.writestr(name, pick((b"", b"\x80\x02N.", data[:99]), j))
    protocol = j % 6
    kinds = (
        file.getvalue(), pickle.dumps({"state_dict": {}}, protocol), pickle.dumps(_Evil(), protocol),
        saved({"state_dict": _Evil()}), pickle.dumps([1], protocol), saved([1, 2]), saved({"state_dict": {}}),
        saved({"state_dict": {}, "neurad": {}}), b"PK\3\4", b"", saved({"state_dict": None, "neurad": None}),
        b"\x80\x02" + b"(" * 100_000 + b".", b"\x1f\x8b" + data[:500], data + data, b"\0" * 5000,
        saved(torch.zeros(3)), saved(None), saved({5: 6}), b"{}", b"version https://git-lfs.github.com/spec/v1\n",
    )  # fmt: skip
    return pick(kinds, i) if k % 2 else sealed(pick(kinds, i))


RUNS = ("flip", "cut", "insert", "entry", "entry", "weights", "weights", "other", "config", "table", "kind")
"""Mutations of runs, by name."""


def write_run(recipe: dict, folder: Path) -> Path:
    """Copy the finished run into ``lightning_logs/version_0`` and spoil it; returns the path of its checkpoint."""
    run, last = folder / "lightning_logs/version_0", "checkpoints/last.ckpt"
    shutil.copytree(recipe["run"], run)
    files = {name: (run / name).read_bytes() for name in (last, "config.yaml", "metrics.csv")}
    whole = files[last]
    content = torch.load(io.BytesIO(whole), weights_only=True)
    for name, i, j, k in recipe["mutations"]:
        if name in ("entry", "weights"):
            if isinstance(content, dict) and content:
                content = {"entry": entry, "weights": weights}[name](content, i, j, k)
            files[last] = saved(content)
        elif name == "other":
            files[last] = other(whole, i, j, k)
        elif name == "kind":
            GENERAL[name](files, i, j, k)
        else:
            target = {"config": "config.yaml", "table": "metrics.csv"}.get(name, last)
            one = {target: files[target]}
            GENERAL[name if target == last else pick(("token", "line", "flip", "cut", "insert"), i)](one, 0, j, k)
            files[target] = sealed(one[target]) if target == last and k % 3 == 0 else one[target]
    for name in files:
        (run / name).unlink()
    write_files(files, run)
    return run / last
