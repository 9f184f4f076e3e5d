"""Edits as files: the YAML behind ``neurad render --edit``."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml  # type: ignore[import-untyped]

from neurad.core.errors import InputError
from neurad.core.parameters import BY_NAME, PARAMETERS
from neurad.core.suggest import nearest
from neurad.formats.axes import UP
from neurad.formats.edits.edit import Color, Edit, EnvironmentEdit, LampEdit, MaterialEdit, ObjectEdit, Vector
from neurad.formats.edits.placement import Placement
from neurad.runtime.numbers import LENGTH, RADIANCE, number
from neurad.runtime.reading import expanded, read_text, shown

LAMP = ("scale", "color", "radiance", "move")
ENVIRONMENT = ("file", "turn", "scale", "color")
MATERIAL = tuple(parameter.name for parameter in PARAMETERS)
OBJECT = ("file", "name", "at", "size", "scale", "turn", "up", *MATERIAL, "radiance")
_TURN = 1e6  # degrees


def read_edit(path: str | Path) -> Edit:
    """The edit of a file; paths in it are relative to it.

    Raises:
        InputError: the file is missing or no YAML, or has a key or value that no edit has; the sentence names it.
    """
    source = f"--edit {shown(path)}"
    text = read_text(path)
    try:
        tree = yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise InputError(f"{source}: it is not readable YAML ({shown(' '.join(str(error).split()))})") from error
    return edit_of(tree, source, Path(path).parent)


def edit_of(tree: Any, source: str = "--edit", folder: Path = Path()) -> Edit:
    """The edit that plain values describe.

    Args:
        tree: a mapping with the keys ``lamps``, ``environment``, ``materials`` and ``objects``.
        folder: that paths are relative to.

    Raises:
        InputError: as :func:`read_edit`.
    """
    tree = _mapping({} if tree is None else tree, source, ("lamps", "environment", "materials", "objects"))
    lamps = _named(tree, "lamps", source)
    materials = _named(tree, "materials", source)
    objects = tree.get("objects") or []
    if not isinstance(objects, list):
        raise InputError(f"{source}: objects has to be a list, one entry for each thing")
    environment = tree.get("environment")
    return Edit(
        {name: _lamp(value, f"{source}: lamps: {shown(name)}") for name, value in lamps.items()},
        None if environment is None else _environment(environment, f"{source}: environment", folder),
        {name: _material(value, f"{source}: materials: {shown(name)}") for name, value in materials.items()},
        tuple(_object(value, f"{source}: objects: entry {i + 1}", folder) for i, value in enumerate(objects)),
        source,
    )


def _lamp(value: Any, where: str) -> LampEdit:
    given, light = _light(value, where, LAMP)
    return LampEdit(
        **light,
        radiance=_triple(given, "radiance", where, 0.0, RADIANCE),
        move=_triple(given, "move", where, -LENGTH, LENGTH) or (0.0, 0.0, 0.0),
    )


def _environment(value: Any, where: str, folder: Path) -> EnvironmentEdit:
    given, light = _light(value, where, ENVIRONMENT)
    turn = number(given.get("turn", 0.0), f"{where}: turn", -_TURN, _TURN)
    return EnvironmentEdit(**light, file=_file(given, where, folder), turn=turn)


def _light(value: Any, where: str, keys: tuple[str, ...]) -> tuple[Mapping[str, Any], dict[str, Any]]:
    """A mapping with some of these keys, empty for ``off`` and for a factor; and of the edit what every light has."""
    if value is False or value == "off":  # YAML takes the plain word for a truth value
        return {}, {"off": True}
    if _is_number(value):
        return {}, {"scale": number(value, where, 0.0, RADIANCE)}
    given = _mapping(value, where, keys, "off, a factor, or a mapping")
    scale = number(given.get("scale", 1.0), f"{where}: scale", 0.0, RADIANCE)
    return given, {"scale": scale, "color": _tint(given, where)}


def _material(value: Any, where: str) -> MaterialEdit:
    given = _mapping(value, where, MATERIAL)
    values: dict[str, tuple[float, ...] | None] = {}
    for name in (name for name in MATERIAL if given.get(name) is not None):
        one = BY_NAME[name].channels == 1
        values[name] = (
            (number(given[name], f"{where}: {name}", 0.0, 1.0),) if one else _triple(given, name, where, 0.0, 1.0)
        )
    return {name: value for name, value in values.items() if value is not None}


def _object(value: Any, where: str, folder: Path) -> ObjectEdit:
    given = _mapping(value, where, OBJECT)
    file, at = _file(given, where, folder), _triple(given, "at", where, -LENGTH, LENGTH)
    if file is None or at is None:
        raise InputError(f"{where}: it has no {'file' if file is None else 'place (at: [x, y, z])'}")
    up, size, name = given.get("up", "y"), given.get("size"), given.get("name")
    if up not in UP:
        raise InputError(f"{where}: up is {shown(up)}, which is none of {', '.join(UP)}")
    if name is not None and not isinstance(name, str):
        raise InputError(f"{where}: name is {shown(repr(name))}, not a text")
    placement = Placement(
        at=at,
        size=None if size is None else number(size, f"{where}: size", 1e-12, LENGTH),
        scale=number(given.get("scale", 1.0), f"{where}: scale", 1e-12, LENGTH),
        turn=number(given.get("turn", 0.0), f"{where}: turn", -_TURN, _TURN),
        up=up,
    )
    material = _material({key: x for key, x in given.items() if key in MATERIAL}, where)
    return ObjectEdit(file, placement, name, material, _triple(given, "radiance", where, 0.0, RADIANCE))


def _mapping(value: Any, where: str, keys: tuple[str, ...], expected: str = "a mapping") -> Mapping[str, Any]:
    """A mapping with some of these keys."""
    if not isinstance(value, dict):
        raise InputError(f"{where}: it is {shown(repr(value))}, but {expected} with keys {', '.join(keys)} is needed")
    for key in value:
        if key not in keys:
            near = nearest(str(key), keys)
            hint = f"there are {', '.join(keys)}" if near is None else f"did you mean {near}?"
            raise InputError(f"{where}: there is no key {shown(key)}; {hint}")
    return value


def _named(tree: Mapping[str, Any], key: str, source: str) -> dict[str, Any]:
    """A mapping from names to something; numbers are names, too."""
    found = tree.get(key)
    if found is None:
        return {}
    if not isinstance(found, dict):
        raise InputError(f"{source}: {key} has to be a mapping from names to what becomes of them")
    return {str(name): value for name, value in found.items()}


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _triple(given: Mapping[str, Any], key: str, where: str, low: float, high: float) -> Vector | None:
    """Three numbers, or one that stands for all three."""
    value = given.get(key)
    if value is None:
        return None
    if _is_number(value):
        value = [value] * 3
    if not isinstance(value, list) or len(value) != 3:
        raise InputError(f"{where}: {key} is {shown(repr(value))}, which is not three numbers")
    x, y, z = (number(entry, f"{where}: {key}", low, high) for entry in value)
    return x, y, z


def _tint(given: Mapping[str, Any], where: str) -> Color | None:
    """A colour that is not black, as its brightness does not count."""
    color = _triple(given, "color", where, 0.0, RADIANCE)
    if color is not None and not any(color):
        raise InputError(f"{where}: color is black; a scale of 0 is dark")
    return color


def _file(given: Mapping[str, Any], where: str, folder: Path) -> str | None:
    file = given.get("file")
    if file is None:
        return None
    if not isinstance(file, str) or not file:
        raise InputError(f"{where}: file is {shown(repr(file))}, not the name of a file")
    return str(folder / expanded(file, f"{where}: file"))
