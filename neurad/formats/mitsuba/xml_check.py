"""A look at scene files before Mitsuba parses them: its parser recurses, and opens whatever is included, pipes too."""

from collections.abc import Sequence
from pathlib import Path
from xml.parsers import expat

from neurad.core.errors import InputError
from neurad.runtime.reading import TEXT_LIMIT, exists, read_bytes, shown

DEPTH = 64
"""Levels of elements, and of files that include one another: scene files have about five."""


def check_xml(path: Path) -> tuple[list[Path], bool]:
    """Check a scene file and those that it includes.

    Returns:
        The folders in which files are looked for: the scene's own, then those of ``<path>``. Whether it is a file of
        Mitsuba 0.6, as what comes before version 2 is.

    Raises:
        InputError: one cannot be read, is not well-formed, nests too deeply or defines entities, or they include one
            another in a circle.
    """
    folders = [path.parent]
    version = _check(path, folders, (path,))
    return folders, version.strip().startswith(("0.", "1."))


def found_in(folders: Sequence[Path], name: str) -> Path:
    """A file that a scene names, in the first of some folders that has it; in the first one if none has."""
    return next((folder / name for folder in folders if exists(folder / name)), folders[0] / name)


def _check(path: Path, folders: list[Path], chain: tuple[Path, ...]) -> str:
    """Check a file; what it includes lies in one of the ``folders``, to which each ``<path>`` adds one. Returns the
    version that its outermost element has.
    """
    said = (
        f"there is no such file, which {chain[-2].name} includes" if len(chain) > 1 else "there is no such scene file"
    )
    data = read_bytes(path, TEXT_LIMIT, said)
    included: list[str] = []
    depth, version = 0, ""

    def start(name: str, attributes: dict[str, str]) -> None:
        nonlocal depth, version
        depth += 1
        if depth == 1:
            version = attributes.get("version", "")
        if depth > DEPTH:
            line = parser.CurrentLineNumber
            raise InputError(f"{shown(path)}: its elements are nested more than {DEPTH} levels deep (line {line})")
        if name == "include" and "filename" in attributes:
            included.append(attributes["filename"])
        elif name == "path" and "$" not in (value := attributes.get("value", "")):
            folders.append(folders[0] / value)

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
        file = found_in(folders, name)
        if file in chain:
            raise InputError(f"{shown(path)}: it includes {shown(name)}, which includes it again")
        if len(chain) >= DEPTH:
            raise InputError(f"{shown(path)}: files include one another more than {DEPTH} levels deep")
        _check(file, folders, (*chain, file))
    return version
