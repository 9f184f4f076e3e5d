"""``--trust MODULE``: classes of the user's own files in configs.

Naming a class imports its module, and importing runs it. So configs may name what is neurad's, Lightning's or torch's,
and of other modules those that the user names where neurad is started. No config, checkpoint or run folder can.
"""

import argparse
import importlib.util
import sys
import traceback
from collections.abc import Iterable, Iterator, Sequence
from importlib.machinery import ModuleSpec
from pathlib import Path

from neurad.core.errors import InputError
from neurad.core.ranges import shown

SHIPPED = ("neurad", "datamodules", "lightning", "torch.optim", "torch.nn", "datetime")
"""What every config may name."""
NEVER = sys.stdlib_module_names | {"jsonargparse"}
"""Classes of Python and of the parser run commands and write files with what a config says, and none is a method."""
_imported: dict[str, Path] = {}
"""Files of modules that were imported here, by name."""


def add_trust(parser: argparse.ArgumentParser) -> None:
    """Declare ``--trust`` for a verb that reads runs."""
    parser.add_argument(
        "--trust", action="append", default=[], metavar="MODULE",
        help="module of your own, mine for mine.py, that the config may name: it is run",
    )  # fmt: skip


def add_reader(parser: argparse.ArgumentParser) -> None:
    """Declare ``--data.reader`` for a verb that reads a scene folder, as ``fit`` has it."""
    parser.add_argument(
        "--data.reader", dest="reader", metavar="CLASS",
        help="class of your own that reads the folder, mine.Reader of mine.py with --trust mine",
    )  # fmt: skip


def split_words(words: Iterable[str]) -> Iterator[tuple[str, str | None, list[str]]]:
    """Options of a command line with their values, and all other words with None; each with the words that say it.

    Both ``--key=value`` and ``--key value`` are understood.
    """
    queue = list(words)
    while queue:
        word = queue.pop(0)
        key, equals, value = word.partition("=")
        if not key.startswith("--") and key != "-c":
            yield word, None, [word]
        elif equals:
            yield key, value, [word]
        elif queue and not queue[0].startswith("--"):
            yield key, queue[0], [word, queue.pop(0)]
        else:
            yield key, None, [word]


def split_trust(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """Values of ``--trust``, which may be repeated, and all other words of a command line.

    Raises:
        InputError: nothing follows it.
    """
    values, others = [], []
    for key, value, said in split_words(words):
        if key != "--trust":
            others += said
        elif value is None or (said[-1].startswith("-") and len(said) > 1):
            raise InputError("--trust needs the name of a module, such as mine for mine.py")
        else:
            values.append(value)
    return values, others


def import_trusted(words: str | Iterable[str], folders: Iterable[Path] = ()) -> tuple[str, ...]:
    """Import the modules that the user trusts, from the working folder, given folders or what is installed.

    Args:
        words: names of modules; several in one word are separated by commas.
        folders: of the configs that the user named. Never that of a run: it may have come from somebody else.

    Returns:
        The names.

    Raises:
        InputError: a name is none or never trusted, stands for no file or for several, or its import fails.
    """
    words = [words] if isinstance(words, str) else words
    names = tuple(name.strip() for word in words for name in word.split(","))
    for name in names:
        if name.endswith(".py") or not all(part.isidentifier() for part in name.split(".")):
            raise InputError(f"--trust {shown(name)}: it is no name of a module, such as mine for mine.py")
        if name.split(".")[0] in NEVER:
            raise InputError(f"--trust {name}: no class of Python's own modules or of the parser may be named")
        _import(name.split(".")[0], [Path(), *folders])
    return names


def is_trusted(path: str, trusted: Iterable[str]) -> bool:
    """Whether ``a.b.Class`` lies in one of the modules."""
    return any(path.startswith(f"{name}.") for name in trusted) and all(part.isidentifier() for part in path.split("."))


def how_to_trust(path: str) -> str:
    """The end of a sentence that refuses a class: how to allow it, where a user may."""
    top, dot, _ = path.partition(".")
    if not top.isidentifier() or not dot or top in NEVER or top in {name.split(".")[0] for name in SHIPPED}:
        return ""
    return f"; if {top} is your own, give --trust {top} (in Python, trust='{top}'), which runs it"


def _import(top: str, folders: Iterable[Path]) -> None:
    """Import a module, unless the one of that file is."""
    found = {Path(spec.origin).resolve(): spec for spec in _specs(top, folders) if spec.origin}
    if len(found) != 1:
        where = f"there are several: {', '.join(map(str, found))}" if found else "no such module here or installed"
        raise InputError(f"--trust {top}: {where}")
    ((file, spec),) = found.items()
    if top in sys.modules and _imported.get(top, file) == file:
        return
    for name in [name for name in sys.modules if name == top or name.startswith(f"{top}.")]:
        del sys.modules[name]
    module = sys.modules[top] = importlib.util.module_from_spec(spec)
    _imported[top] = file
    try:
        assert spec.loader is not None
        spec.loader.exec_module(module)
    except Exception as error:
        del sys.modules[top]
        lines = [place.lineno for place in traceback.extract_tb(error.__traceback__) if place.filename == str(file)]
        where = f"{file}, line {lines[-1]}" if lines else str(file)
        raise InputError(f"--trust {top}: {where}: {type(error).__name__}: {error}") from error


def _specs(top: str, folders: Iterable[Path]) -> Iterator[ModuleSpec]:
    """Where a module may come from."""
    for folder in (folder.resolve() for folder in folders):
        for file, inside in ((folder / f"{top}.py", None), (folder / top / "__init__.py", [str(folder / top)])):
            if file.is_file():
                spec = importlib.util.spec_from_file_location(top, file.resolve(), submodule_search_locations=inside)
                if spec is not None:
                    yield spec
    kept = {name: sys.modules.pop(name) for name in [top] if name in _imported and name in sys.modules}
    try:
        spec = importlib.util.find_spec(top)  # of what is imported already its own
    except ValueError:  # it has none
        spec = None
    finally:
        sys.modules.update(kept)
    if spec is not None:
        yield spec
