"""Every setting with its words, read from the source of the classes that have them, without importing these.

Importing them takes seconds, since torch and Lightning come with them; their text says the same at once. What a class
takes stands in its dataclass fields and the strings behind them, or in its ``__init__`` and the ``Args:`` of its
docstring.
"""

from __future__ import annotations

import ast
import inspect
import typing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

import neurad
from neurad.core import ranges
from neurad.core.ranges import Range

SOURCES = Path(neurad.__file__).resolve().parent.parent
"""Where the packages lie."""
GROUPS = {
    "data": ("datamodules/scene_data.py", "SceneData", "Photographs, and the pixels that a step sees of them"),
    "model": ("neurad/training/inverse.py", "InverseRenderer", "What is recovered, and how"),
    "evaluation": ("neurad/callbacks/evaluation.py", "Evaluate", "Scores and pictures of held-out views"),
    "checkpoint": ("neurad/callbacks/checkpoint.py", "LastCheckpoint", "Checkpoints"),
}
"""Groups of settings: file and name of the class that has them, and what they are about."""
METHODS = "neurad/integrators"
"""Folder of the methods, whose settings are ``model.method.init_args``."""
LARGE = 1 << 31
"""Whole numbers so large are not worth saying."""
_KINDS = {int: "whole number", float: "number", bool: "true or false", str: "text"}


@dataclass(frozen=True)
class Setting:
    """A setting."""

    key: str
    """With dots."""
    words: str
    """What it means; empty where nobody says."""
    kind: str
    """What its value may be, with its range."""
    default: Any
    """:data:`REQUIRED` where there is none."""
    allowed: Range | None = None


@dataclass(frozen=True)
class _Class:
    """A class that is not imported: its name in a type."""

    file: Path
    name: str

    def __or__(self, other: Any) -> Any:
        return self

    __ror__ = __or__


class _Required:
    def __repr__(self) -> str:
        return "needed"


REQUIRED = _Required()


class _Source(Mapping[str, Any]):
    """A file of source, and what names in its types and defaults stand for."""

    def __init__(self, file: Path) -> None:
        self.file = file
        self.tree = ast.parse(file.read_text(encoding="utf-8"))
        self.classes = {node.name: node for node in self.tree.body if isinstance(node, ast.ClassDef)}
        self.imports: dict[str, tuple[str, str]] = {}
        for node in ast.walk(self.tree):
            if isinstance(node, ast.ImportFrom) and node.module:
                self.imports |= {alias.asname or alias.name: (node.module, alias.name) for alias in node.names}
        self.constants = {
            target.id: node.value
            for node in self.tree.body
            if isinstance(node, ast.Assign)
            for target in node.targets
            if isinstance(target, ast.Name)
        }

    def __getitem__(self, name: str) -> Any:
        if name in ("Annotated", "Literal"):
            return {"Annotated": Annotated, "Literal": Literal}[name]
        if name in self.classes:
            return _Class(self.file, name)
        if name in self.constants:
            return self.value(self.constants[name])
        if name in self.imports:
            module, attribute = self.imports[name]
            if module == ranges.__name__:
                return getattr(ranges, attribute)
            file = SOURCES / (module.replace(".", "/") + ".py")
            if file.is_file():
                return source(file)[attribute]
        raise KeyError(name)

    def __iter__(self) -> Iterator[str]:
        return iter((*self.classes, *self.constants, *self.imports))

    def __len__(self) -> int:
        return len(self.classes) + len(self.constants) + len(self.imports)

    def value(self, node: ast.expr) -> Any:
        """What a type or a constant in this file is."""
        return eval(compile(ast.Expression(node), str(self.file), "eval"), {}, self)


@cache
def source(file: Path) -> _Source:
    """A file of source, read once."""
    return _Source(file)


def all_settings() -> dict[str, list[Setting]]:
    """Every setting by the group that it is shown in, with a heading for each."""
    found: dict[str, list[Setting]] = {}
    for group, (file, name, about) in GROUPS.items():
        settings = list(_settings(_Class(SOURCES / file, name), group, {}))
        found[f"{group}: {about}"] = settings
    alike: dict[tuple[str, ...], tuple[list[str], list[Setting]]] = {}  # methods may take the same
    for name, settings in methods().items():
        if settings:
            alike.setdefault(tuple(map(str, settings)), ([], settings))[0].append(name)
    return found | {f"model.method.class_path {' or '.join(names)}": settings for names, settings in alike.values()}


def methods() -> dict[str, list[Setting]]:
    """Settings of every method, by the path of its class."""
    known, found = {"Method"}, {}
    files = [source(file) for file in sorted((SOURCES / METHODS).glob("*.py"))]
    for _ in files:  # a method may be made of another that comes later
        for file in files:
            for name, node in file.classes.items():
                if known & {base.id for base in node.bases if isinstance(base, ast.Name)} and name not in known:
                    known.add(name)
                    path = file.file.relative_to(SOURCES).with_suffix("").as_posix().replace("/", ".")
                    found[f"{path}.{name}"] = list(_settings(_Class(file.file, name), "model.method.init_args", {}))
    return dict(sorted(found.items()))


def _settings(owner: _Class, prefix: str, given: Mapping[str, Any]) -> Iterator[Setting]:
    """The settings of a class and of those inside it.

    Args:
        owner: the class.
        prefix: key of the group.
        given: values that replace defaults.
    """
    for name, (where, hint, default, words) in _fields(owner).items():
        type_ = where.value(hint)
        values = {} if default is None else _arguments(where, default)
        inner = next((part for part in _parts(type_) if isinstance(part, _Class)), None)
        if inner is not None and _is_dataclass(inner):
            yield from _settings(inner, f"{prefix}.{name}", values)
            continue
        value = given[name] if name in given else REQUIRED if default is None else where.value(default)
        if isinstance(value, _Class):
            value = value.name
        yield Setting(f"{prefix}.{name}", " ".join(words.split()), _kind(type_), value, ranges.range_of(type_))


_Field = tuple[_Source, ast.expr, "ast.expr | None", str]
"""File, type, default and words."""


def _fields(owner: _Class) -> dict[str, _Field]:
    """What a class takes by name."""
    file = source(owner.file)
    node = file.classes[owner.name]
    found: dict[str, _Field] = {}
    for base in node.bases:
        if isinstance(base, ast.Name) and isinstance(parent := _known(file, base.id), _Class):
            found |= _fields(parent)
    if _is_dataclass(owner):
        for entry, after in zip(node.body, [*node.body[1:], None], strict=True):
            if isinstance(entry, ast.AnnAssign) and isinstance(entry.target, ast.Name):
                name = entry.target.id
                inherited = found[name][3] if name in found else ""
                found[name] = (file, entry.annotation, entry.value, _text(after) or inherited)
        return found
    words = described(ast.get_docstring(node) or "")
    inits = [n for n in node.body if isinstance(n, ast.FunctionDef) and n.name == "__init__"]
    for init in inits:
        arguments = [argument for argument in init.args.args if argument.arg != "self"]
        defaults = [None] * (len(arguments) - len(init.args.defaults)) + list(init.args.defaults)
        for argument, default in zip(arguments, defaults, strict=True):
            assert argument.annotation is not None
            found[argument.arg] = (file, argument.annotation, default, words.get(argument.arg, ""))
    if not inits:
        found = {name: (*field[:3], words.get(name, field[3])) for name, field in found.items()}
    return found


def _known(file: _Source, name: str) -> Any:
    """What a name stands for; None for what other packages have."""
    try:
        return file[name]
    except KeyError:
        return None


def _is_dataclass(owner: _Class) -> bool:
    """Whether a class is a group of settings."""
    node = source(owner.file).classes[owner.name]
    return any("dataclass" in ast.unparse(decorator) for decorator in node.decorator_list)


def _text(node: ast.stmt | None) -> str:
    """The string behind a field."""
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
        return node.value.value
    return ""


def described(docstring: str) -> dict[str, str]:
    """The ``Args:`` of a docstring by name."""
    found: dict[str, str] = {}
    name, inside = "", False
    for line in inspect.cleandoc(docstring).splitlines():
        indent = len(line) - len(line.lstrip())
        if indent == 0 and line.strip():
            inside = line.strip() == "Args:"
        elif inside and indent == 4 and ":" in line:
            name, _, text = line.strip().partition(":")
            found[name] = text
        elif inside and indent > 4:
            found[name] += f" {line.strip()}"
    return found


def _arguments(file: _Source, default: ast.expr) -> dict[str, Any]:
    """Values in a default such as ``GridConfig(levels=4)``."""
    if not isinstance(default, ast.Call):
        return {}
    return {word.arg: file.value(word.value) for word in default.keywords if word.arg is not None}


def _parts(hint: Any) -> tuple[Any, ...]:
    """The alternatives of a type."""
    return typing.get_args(hint) if _is_union(hint) else (hint,)


def _is_union(hint: Any) -> bool:
    return type(hint).__name__ in ("UnionType", "Union", "_UnionGenericAlias")


def _kind(hint: Any) -> str:
    """What a value may be, in words."""
    allowed = ranges.range_of(hint)
    parts = [part for part in _parts(hint) if part is not type(None)]
    optional = " or null" if len(parts) < len(_parts(hint)) else ""
    part = parts[0]
    if isinstance(part, _Class):
        return "name of a class" + optional
    if typing.get_origin(part) is Literal:
        return " or ".join(str(choice) for choice in typing.get_args(part)) + optional
    if typing.get_origin(part) is Annotated:
        part = typing.get_args(part)[0]
    if typing.get_origin(part) in (list, tuple):
        return "list of texts" + optional
    words = _KINDS.get(part, str(part))
    if allowed is not None:
        most = "" if allowed.high >= LARGE - 1 else str(allowed)
        words += f", {most or Range(allowed.low, above=allowed.above)}"
    return words.removesuffix(", finite") + optional
