"""A look at scene files before Mitsuba parses them: its parser recurses, and opens whatever is included, pipes too."""

from __future__ import annotations

from pathlib import Path
from xml.parsers import expat

from neurad.core.errors import InputError
from neurad.runtime.reading import TEXT_LIMIT, read_bytes, shown

DEPTH = 64
"""Levels of elements, and of files that include one another: scene files have about five."""


def check_xml(path: Path) -> None:
    """Check a scene file and those that it includes.

    Raises:
        InputError: one cannot be read, is not well-formed, nests too deeply or defines entities, or they include one
            another in a circle.
    """
    _check(path, path.parent, (path,))


def _check(path: Path, folder: Path, chain: tuple[Path, ...]) -> None:
    """Check a file; what it includes is relative to ``folder``, that of the first one."""
    said = (
        f"there is no such file, which {chain[-2].name} includes" if len(chain) > 1 else "there is no such scene file"
    )
    data = read_bytes(path, TEXT_LIMIT, said)
    included: list[str] = []
    depth = 0

    def start(name: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        if depth > DEPTH:
            line = parser.CurrentLineNumber
            raise InputError(f"{shown(path)}: its elements are nested more than {DEPTH} levels deep (line {line})")
        if name == "include" and "filename" in attributes:
            included.append(attributes["filename"])

    def end(_: str) -> None:
        nonlocal depth
        depth -= 1

    def entity(*_: object) -> None:
        raise InputError(
            f"{shown(path)}: it defines entities (line {parser.CurrentLineNumber}), which are not supported"
        )

    parser = expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler, parser.EntityDeclHandler = start, end, entity
    try:
        parser.Parse(data, True)
    except (expat.ExpatError, ValueError, LookupError) as error:  # the latter for encodings that are unknown
        raise InputError(f"{shown(path)}: it is not well-formed XML ({error})") from error
    for name in included:
        if "$" in name:  # a parameter, which Mitsuba knows
            continue
        file = folder / name
        if file in chain:
            raise InputError(f"{shown(path)}: it includes {shown(name)}, which includes it again")
        if len(chain) >= DEPTH:
            raise InputError(f"{shown(path)}: files include one another more than {DEPTH} levels deep")
        _check(file, folder, (*chain, file))
