"""Photographs by the names that cameras give them, which may come from another system or lie in another folder."""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path, PurePosixPath, PureWindowsPath

from neurad.core.errors import InputError
from neurad.images.photographs import RAW, READABLE, kind_of
from neurad.images.picture_notes import note
from neurad.runtime.reading import exists, in_other_case, regular_file, shown

OTHER = (".webp", ".bmp", ".heic", ".gif", *RAW)
"""Endings of photographs that are not read."""


def any_case(path: Path) -> Path | None:
    """What a path leads to, or another that differs in upper and lower case alone, which is noted; None for neither.

    Raises:
        InputError: several others do.
    """
    if exists(path):
        return path
    if (other := in_other_case(path)) is not None:
        note("the cameras write such names in other upper and lower case", other)
    return other


def listed_file(path: Path, missing: str) -> Path:
    """A file that a camera file lists, found as :func:`any_case` does.

    Raises:
        InputError: it is not there (``missing``), or is no file to read.
    """
    return regular_file(any_case(path) or path, missing)


def _first_there(paths: Sequence[Path]) -> Path | None:
    """The first of some paths that leads anywhere, by its letters or else by letters of other case."""
    found = next((path for path in paths if exists(path)), None)
    return found or next((path for path in map(any_case, paths) if path is not None), None)


class Photographs:
    """Finds the photographs of a source: of each its EXR file or, where there is none, that which it names.

    Args:
        places: folders to look in, one after the other.
        moved: the photographs lie not where the source says (``--images``): any end of a name may be that of a path in
            these folders, so that folders of another computer do not matter.
    """

    def __init__(self, *places: Path, moved: bool = False) -> None:
        self.places = places
        self.moved = moved

    def named(self, name: str) -> Path | None:
        """The photograph of a camera, whose name is that of the file without its ending; None where there is none.

        A part of the name behind a dot is no ending: Blender counts its objects there.
        """
        plain = name and not set(name) & set("/\\:")
        return self._first(PurePosixPath(f"{name}{ending}") for ending in READABLE) if plain else None

    def __call__(self, name: str, where: str) -> Path:
        """The file; a refusal, that there is none or its name leads out of the folder, begins with ``where``."""
        parts, leads_out = _parts(name)
        if not parts or (leads_out and not self.moved):
            raise InputError(
                f"{where}: the name of its photograph, {shown(repr(name))}, leads out of the folder; say where they "
                "are with --images"
            )
        ends = [PurePosixPath(*parts[i:]) for i in range(len(parts) if self.moved else 1)]
        flat = [_exr(end) for end in (*ends, PurePosixPath(parts[-1]))]
        found = self._first([*flat, *(end.with_name(f"{end.name}.exr") for end in ends), *_as_named(ends)])
        if found is None:
            looked = " or ".join(shown(place) for place in self.places)
            raise InputError(f"{where}: its photograph {shown(flat[0])} is in none of {looked}")
        return _readable(found, where)

    def _first(self, names: Iterable[PurePosixPath]) -> Path | None:
        return _first_there([place / name for place in self.places for name in dict.fromkeys(names)])


def photographs_of(images: Path | None, *own: Path) -> Photographs:
    """What finds photographs in the folder of ``--images`` or, without it, in a source's own folders."""
    return Photographs(*own) if images is None else Photographs(images, moved=True)


def listed_photograph(root: Path, name: str, where: str, file: str) -> Path:
    """The photograph of a frame of a scene folder, which may lie anywhere: that of its name, or with an ending more.

    Args:
        root: of relative names.
        name: as it is listed; what Blender writes has no ending.

    Raises:
        InputError: there is none, or it is none that is read.
    """
    paths = _listed(root, name)
    if not paths:
        raise InputError(f"{where}: its file_path {shown(repr(name))} is not the name of a file")
    found = _first_there(paths)
    if found is None:
        return regular_file(paths[0], f"the photograph is missing that {file} lists (an EXR file)")
    return _readable(found, where)


def expected_photograph(root: Path, name: str) -> Path:
    """The file where :func:`listed_photograph` would find a photograph, which does not have to be there."""
    paths = _listed(root, name)
    known = paths and paths[-1].suffix.lower() in (*READABLE, *OTHER) and len(paths) <= 2
    return next((file for file in paths if file.is_file()), paths[-1] if known else paths[0] if paths else root / name)


def _listed(root: Path, name: str) -> list[Path]:
    """The files that the name of a photograph may mean, an EXR file first; none if it is not the name of a file."""
    path = root / name.replace("\\", "/")
    if not path.name:
        return []
    exr = path if path.suffix.lower() == ".exr" else path.with_name(f"{path.name}.exr")
    return [exr, *(path.with_name(end.name) for end in _as_named([PurePosixPath(path.name)]))]


def _parts(name: str) -> tuple[tuple[str, ...], bool]:
    """The parts of a name as any system writes it, without a drive, and whether it leads out of its folder."""
    path = PureWindowsPath(name)
    parts = path.parts[1:] if path.anchor else path.parts
    inner = tuple(part for part in parts if part != "..")
    return inner, bool(path.anchor) or len(inner) < len(parts)


def _exr(path: PurePosixPath) -> PurePosixPath:
    """The name of the EXR file of a photograph; a number behind a dot is no ending."""
    ends = path.suffix and not path.suffix[1:].isdigit()
    return path.with_suffix(".exr") if ends else path.with_name(f"{path.name}.exr")


def _as_named(paths: Iterable[PurePosixPath]) -> Iterator[PurePosixPath]:
    """Names as they are, and with the endings of photographs, which some programs omit."""
    for path in paths:
        yield path
        if path.suffix.lower() not in (*READABLE, *OTHER):
            yield from (path.with_name(path.name + ending) for ending in (*READABLE, *OTHER))


def _readable(file: Path, where: str) -> Path:
    """A photograph, if its ending is of those that are read."""
    ending = file.suffix.lower()
    if ending in READABLE:
        return regular_file(file)
    if ending in OTHER:
        how = "merge it with `neurad data hdr`" if ending in RAW else "save it in one of these formats"
    elif (kind := kind_of(regular_file(file))) is not None:
        how = f"by its content it is {kind}: name it {file.name}{kind}"
    else:
        how = f"put {_exr(PurePosixPath(file.name))} beside it, or name the folder of such files with --images"
    raise InputError(f"{where}: its photograph is {shown(file)}: this is none of {', '.join(READABLE)}: {how}")
