"""Loading scenes: built-in ones, and folders with a scene file and camera files."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from neurad.core.errors import InputError
from neurad.core.records import Float64Array
from neurad.core.suggest import did_you_mean
from neurad.formats.cameras import HOLD_OUT, RELIGHT
from neurad.formats.cameras.nerf import FILM, Split, read_cameras, read_one, read_split
from neurad.formats.hints import hinted
from neurad.formats.reader import Reader
from neurad.images.development import KNOWN, Photography, developed
from neurad.images.picture_notes import say_pictures
from neurad.runtime.progress import phase
from neurad.runtime.reading import exists, in_other_case, regular_file, shown
from neurad.runtime.reading import folder as existing_folder
from neurad.scene.description import Scene
from neurad.scene.flatten import flattened
from neurad.scene.origin import ZERO, moved_views, near, origin_of, stored_spacing
from neurad.scene.panes import pane_note

T = TypeVar("T")

OTHER_SCENES = (".glb", ".gltf", ".blend", ".fbx", ".usd", ".usdc", ".usda", ".usdz", ".pbrt", ".obj", ".ply", ".stl")
"""Files of other programs that somebody may take for a scene here."""
CAMERAS = "cameras.json"
"""Cameras without photographs, in the form of other camera files."""


def _mitsuba(path: Path, origin: Float64Array) -> Scene:
    from neurad.formats.mitsuba.read import read_xml

    return read_xml(path, origin)


def _gltf(path: Path, origin: Float64Array) -> Scene:
    from neurad.formats.gltf.read import read_scene

    return near(read_scene(path), origin)


SCENE_FILES: dict[str, Callable[[Path, Float64Array], Scene]] = {
    "scene.xml": _mitsuba,
    "scene.glb": _gltf,
    "scene.gltf": _gltf,
}
"""Readers of meshes, materials and lights, by file name in upper or lower case; the first one in a folder is read. They
are given what to subtract from all coordinates. What a file says of cameras becomes held-out views without photographs.
"""
CAMERA_FILES: dict[str, Callable[[Path, int, bool], Split]] = {
    "transforms_train.json": read_split,
    "transforms.json": read_one,
    CAMERAS: lambda folder, hold_out, pictures: Split([], read_cameras(folder / CAMERAS, FILM)),
}
"""Readers of the training and the held-out views, by file name; the first one in a folder is read. They are given how
many-th photograph to hold out where the file does not say which, and whether photographs have to be there.
"""


def load_scene(
    root: str | None,
    scene: str | None,
    hold_out: int = HOLD_OUT,
    photography: Photography | None = KNOWN,
    hints: str | Sequence[Any] | None = None,
    reader: Reader | None = None,
) -> Scene:
    """The scene of a folder or a built-in one, checked; nothing in it has to shine, as that may be found.

    Args:
        root: a scene folder (``--data.root``), or None.
        scene: name of a built-in scene (``--data.scene``), or None.
        hold_out: every so many-th photograph of a folder is held out where nothing says which; 0 for none.
        photography: what is known of how the photographs were taken; None where they are not wanted: then they need not
            be there, nor masks and maps.
        hints: what is said of places in it: a file, or its entries.
        reader: of the user's own, for a folder; None for the files that neurad knows.

    Raises:
        InputError: none or both are given, the name is unknown, or the scene cannot be used.
    """
    if root is None and scene is None:
        raise InputError("a scene folder (data.root) or the name of a built-in scene (data.scene) is needed")
    if root is not None and scene is not None:
        both = f"both the scene folder {root} (data.root) and the built-in scene {scene} (data.scene) are given"
        raise InputError(f"{both}; the config for a folder is scene.yaml")
    with phase("reading"):
        if root is not None:
            found = read_folder(root, hold_out, photography, reader).check(lit=False)
            say_pictures()
            return hinted(flattened(found), hints)
        if reader is not None:
            raise InputError(f"--data.reader: it reads a folder (data.root), and {scene} (data.scene) is built in")
        from neurad.scene.builtin import build

        assert scene is not None
        return hinted(_developed(build(scene), photography).check(lit=False), hints)


def _developed(scene: Scene, photography: Photography | None) -> Scene:
    """The scene, whose views say how their photographs become radiance, where that is wanted."""
    if photography is None:
        return scene
    train, test, notes = developed(scene.train, scene.test, photography)
    return replace(scene, train=train, test=test, notes=(*scene.notes, *notes), photography=photography)


def read_folder(
    root: str | Path,
    hold_out: int = HOLD_OUT,
    photography: Photography | None = KNOWN,
    reader: Reader | None = None,
) -> Scene:
    """The scene of a folder with one of :data:`SCENE_FILES` and one of :data:`CAMERA_FILES`, or with what a ``reader``
    of the user's own takes in place of one or both.

    Only the existence of photographs and maps is checked, of photographs without a size in the camera file the size,
    and of those of codes the format and EXIF.

    Raises:
        InputError: something is missing or wrong; the sentence names the file and the frame.
    """
    if Path(root).suffix.lower() in OTHER_SCENES and Path(root).is_file():
        raise InputError(f"--data.root: {shown(root)}: {_otherwise(Path(root))}")
    folder = existing_folder(root, "--data.root")
    reader, surfaces = reader or Reader(), None
    has_cameras = reader.reads("views") or any(exists(folder / name) for name in CAMERA_FILES)
    if reader.reads("surfaces"):
        read_surfaces = partial(_of_type, Scene, reader.surfaces, folder)
    else:
        file, read_file = _reader(SCENE_FILES, folder)
        read_surfaces = partial(read_file, file)
        # glTF may have cameras, to be rendered
        if read_file is _gltf and not has_cameras:
            surfaces = _near_origin(read_surfaces)
            if surfaces.test:
                return replace(surfaces, name=folder.name, notes=(*surfaces.notes, *surface_notes(surfaces)))
    if reader.reads("views"):
        views = _of_type(Split, reader.views, folder, hold_out, photography is not None)
    else:
        views = _reader(CAMERA_FILES, folder)[1](folder, hold_out, photography is not None)
    relight = None
    if any(view.relight for view in views.test):
        relight = str(regular_file(folder / RELIGHT, "the map is missing that lights the photographs of relight_path"))
    surfaces = _near_origin(read_surfaces) if surfaces is None else surfaces
    surfaces = replace(
        surfaces, name=folder.name, relight=relight, notes=(*surfaces.notes, *surface_notes(surfaces), *views.notes)
    )
    if views.diffuse is not None:
        surfaces = surfaces.with_diffuse(views.diffuse)
    step = -np.asarray(surfaces.origin)
    train, test = moved_views(views.train, step), moved_views(views.test, step)
    return _developed(replace(surfaces, train=train, test=test), photography)


def _of_type(kind: type[T], read: Callable[..., T], *arguments: Any) -> T:
    """What a function of a reader gives back.

    Raises:
        InputError: it is of another type.
    """
    found = read(*arguments)
    if not isinstance(found, kind):
        raise InputError(
            f"--data.reader: {read.__qualname__} gives back a {type(found).__name__}, not a {kind.__name__}"
        )
    return found


def _near_origin(read: Callable[[Float64Array], Scene]) -> Scene:
    """Surfaces, moved near the origin of their coordinates where they lie far from it."""
    surfaces = read(ZERO)
    origin = origin_of(surfaces.meshes)
    if not origin.any():
        return surfaces
    x, y, z = (float(value) for value in origin)
    return replace(read(origin), origin=(x, y, z))


def surface_notes(scene: Scene) -> list[str]:
    """What is to be said of the surfaces of a scene, whatever it was read from, a sentence each."""
    if not any(scene.origin):
        return pane_note(scene)
    place = ", ".join(f"{x:.10g}" for x in scene.origin)
    far = (
        f"the room lies far from the origin of its coordinates: ({place}) is subtracted from all of them while it is "
        "computed with, and added again to what is given back"
    )
    coarse = stored_spacing(scene)
    if coarse > 0.0:
        far = (
            f"warning: its coordinates are numbers of 32 bits, which are {coarse:.2g} apart so far from their origin: "
            f"export it with 64 bits, or nearer the origin. {far[0].upper()}{far[1:]}"
        )
    return [far, *pane_note(scene)]


def _reader(readers: dict[str, T], folder: Path) -> tuple[Path, T]:
    """The first file that the folder has, and its reader."""
    for name, reader in readers.items():
        file = folder / name
        if exists(file) or (readers is SCENE_FILES and (file := in_other_case(file) or file).name != name):
            return file, reader
    first, *others = (name for name in readers if name != CAMERAS)  # which no fit can do with
    instead = f" (or {', '.join(others)})" if others else ""
    other = next((file for file in sorted(folder.iterdir()) if file.suffix.lower() in OTHER_SCENES), None)
    hint = "" if other is None or readers is not SCENE_FILES else f"; {other.name}: {_otherwise(other)}"
    near = did_you_mean(first, [file.name for file in folder.iterdir()])
    raise InputError(f"{folder / first}: the scene folder lacks this file{instead}{hint or near}")


def _otherwise(file: Path) -> str:
    """What to do with a scene that cannot be read where or as it is."""
    kind = {".glb": "gltf", ".gltf": "gltf", ".blend": "blender"}.get(file.suffix.lower())
    if kind is not None:
        return f"`neurad data {kind} {shown(file.name)} --out DIR` makes a scene folder of it"
    return (
        "it cannot be read as a scene; open it in Blender, export it as room.glb, and let "
        "`neurad data gltf room.glb --out DIR` make a scene folder of it"
    )
