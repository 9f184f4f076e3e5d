"""From what other programs write to a scene folder: ``neurad data``."""

import os
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from neurad.core.errors import InputError, Refusals
from neurad.core.ranges import Positive, checked
from neurad.core.records import Float64Array
from neurad.core.scene_records import Development, Mesh, PunctualLight, View
from neurad.formats.axes import axes, held_up, turned
from neurad.formats.cameras import HOLD_OUT
from neurad.formats.cameras.colmap import read_project
from neurad.formats.cameras.fipt import MESH, read_room
from neurad.formats.cameras.intrinsics import SceneCamera
from neurad.formats.cameras.nerf import Split, read_one, read_split
from neurad.formats.cameras.photograph_files import Photographs, photographs_of
from neurad.formats.cameras.polycam import read_export
from neurad.formats.load import read_folder, surface_notes
from neurad.formats.meshes.files import read_meshes
from neurad.formats.meshes.triangles import MeshFile, moved_mesh
from neurad.formats.room_folder import RoomParts, bounds_of, file_name, turned_map, write_room
from neurad.images.photographs import check_view, picture_size
from neurad.images.picture_headers import check_exr
from neurad.images.picture_notes import say_pictures
from neurad.runtime.extras import need
from neurad.runtime.files import check_folder, make_folder, writing
from neurad.runtime.folders import place_of, written_beside
from neurad.runtime.numbers import RADIANCE, number
from neurad.runtime.progress import counted, say
from neurad.runtime.reading import exists, expanded, folder, listed, regular_file, shown
from neurad.scene.description import Scene
from neurad.scene.holes import close_holes
from neurad.scene.origin import place_text
from neurad.scene.punctual import moved_light


@dataclass(frozen=True)
class ImportSettings:
    """What to make a scene folder of."""

    kind: str
    """One of :data:`SOURCES`; or gltf and blender, which have modules of their own."""
    source: Path
    out: Path
    mesh: list[Path] = field(default_factory=list)
    """Mesh files; none for the one that the source has."""
    images: Path | None = None
    """Folder of the photographs as EXR, where they do not lie with the others."""
    up: str | None = None
    """Axis of the meshes that points up; None leaves them as they are."""
    axes: str | None = None
    """The meshes' axes that become those of the cameras, see :func:`neurad.formats.axes.axes`."""
    scale: Positive = 1.0
    """Length of the meshes' unit in the cameras'."""
    close_holes: Positive | None = None
    """Width up to which holes of the meshes are closed, in their unit; None closes none."""
    lamp: list[str] = field(default_factory=list)
    """Meshes that shine, each as ``NAME=R,G,B``."""
    environment: Path | None = None
    """Environment map that lights the room (EXR)."""
    copy: bool = False
    """Copy files instead of linking to them."""
    blender: str | None = None
    """Blender, or a Python that has bpy, which opens a .blend file."""

    def __post_init__(self) -> None:
        checked(self)


def places_of(settings: ImportSettings, source: str) -> tuple[Path, Path | None, Path | None]:
    """The folder to write, that of photographs and the environment map, for a source that has its own meshes.

    Raises:
        InputError: there is an option that is about meshes beside cameras, or one of the places is none.
    """
    own = settings.mesh, settings.lamp, settings.up, settings.axes, settings.close_holes
    if any(own) or settings.scale != 1.0:
        raise InputError(
            f"--mesh, --lamp, --up, --axes, --scale and --close-holes are about meshes beside cameras; {source} has "
            "its own surfaces and lamps, in the frame of its cameras"
        )
    return _places(settings)


def _places(settings: ImportSettings) -> tuple[Path, Path | None, Path | None]:
    out = place_of(expanded(settings.out, "--out"))
    _refuse_taken(out)
    check_folder(out, "--out")
    images = None if settings.images is None else folder(settings.images, "--images")
    if settings.environment is not None:
        check_exr(regular_file(settings.environment, "there is no such environment map"))
    return out, images, settings.environment


def only_file(source: Path, endings: Sequence[str], kind: str) -> Path:
    """The file itself, or the only one of its kind in a folder, which has one of these endings."""
    found = [source]
    if source.is_dir():
        found = [file for file in sorted(source.iterdir()) if file.suffix.lower() in endings]
    if len(found) != 1:
        raise InputError(f"{shown(source)}: it has {len(found)} {kind} files; name the one that is meant")
    return regular_file(found[0], f"there is no such {kind} file").resolve()


def photographed(cameras: Sequence[SceneCamera], images: Path, development: Development | None = None) -> Split:
    """The cameras of a scene that have a photograph of their name, and a sentence on those that have none.

    Raises:
        InputError: no camera has a photograph, or one has other proportions than its camera.
    """
    find, taken = Photographs(images), set[str]()
    views: list[View] = []
    without = []
    for camera in cameras:
        photograph = next((file for name in camera.names if (file := find.named(name)) is not None), None)
        if photograph is None:
            without.append(camera)
            continue
        film = camera.seen(*picture_size(photograph), f"its photograph {shown(photograph.name)}")
        name = file_name(camera.names[0], taken)
        views.append(View(name, film, str(photograph), development=development or Development()))
    for view in counted(views, "reading", len(views), "photographs"):
        check_view(view)
    if not views:
        frame = ", or the number of its frame" if len(without[0].names) > 1 else ""
        raise InputError(
            f"--images {shown(images)}: it has no photograph of any camera, such as {shown(without[0].names[-1])}.exr; "
            f"each has the name of its camera{frame}"
        )
    names = listed(camera.names[0] for camera in without)
    said = f"{len(without)} cameras have no photograph and are left out ({names})"
    return Split(views, [], (said,) if without else ())


def _nerfstudio(source: Path, images: Path | None) -> Split:
    photographs = photographs_of(images, source)
    if exists(source / "transforms_train.json") and not exists(source / "transforms.json"):
        return read_split(source, photograph=photographs)
    return read_one(source, 0, photograph=photographs)


SOURCES: dict[str, tuple[Callable[[Path, Path | None], Split], str]] = {
    "nerfstudio": (_nerfstudio, "a folder with transforms.json"),
    "colmap": (read_project, "a project or model: cameras and images, .bin or .txt"),
    "polycam": (read_export, "Polycam's raw data: keyframes/corrected_cameras"),
    "fipt": (read_room, "a room of FIPT or IRIS, rendered or photographed"),
}
"""What reads a source, and what it is."""


def import_room(settings: ImportSettings) -> None:
    """Make the scene folder, whole or not at all, and say what is in it.

    Raises:
        InputError: a file is missing or broken, a number out of range, the cameras and photographs do not fit, or the
            folder is there already.
    """
    out, images, environment = _places(settings)
    source = folder(settings.source, "SRC")
    lamps = _lamps(settings.lamp)
    views = SOURCES[settings.kind][0](source, images)
    refusals = Refusals()
    every = [*views.train, *views.test]
    for view in counted(every, "reading", len(every), "photographs"):
        with refusals.part():
            check_view(view)
        with refusals.part():
            _check_place(view, [source] if images is None else [source, images])
    refusals.end()
    if settings.mesh or settings.kind == "fipt":
        need("mitsuba", "mitsuba", "a scene folder with meshes (scene.xml)")
    paths = settings.mesh or ([source / MESH] if settings.kind == "fipt" else [])
    if not paths and (lamps or settings.up or settings.axes or environment or settings.close_holes):
        raise InputError(
            "--lamp, --up, --axes, --close-holes and --environment are about what --mesh names, and there is no --mesh"
        )
    files: list[MeshFile] = []
    for path in paths:
        with refusals.part():
            files.append(read_meshes(path))
    refusals.end()
    if settings.close_holes is not None:
        files = [_whole_surfaces(file, settings.close_holes) for file in files]
    if settings.up is None and settings.axes is None:
        files = [_upright(file, views) for file in files]
    if sum(file.environment is not None for file in files) + (environment is not None) > 1:
        raise InputError("there is more than one environment (dome lights of USD, --environment); keep one of them")
    room = RoomParts(views, files, _placed(settings, views), lamps, environment, settings.copy)
    with whole(out) as part:
        meshes = write_room(room, part)
        if meshes:
            check_room(part)
    _say(room, meshes, out)


def whole(out: Path) -> AbstractContextManager[Path]:
    """A new folder beside ``out``, which it becomes at the end of the block; it is removed if the block fails.

    Raises:
        InputError: the system refused to write, or something has come to ``out``.
    """
    make_folder(out.parent, "--out")
    return written_beside(out, lambda: _refuse_taken(out))


def _refuse_taken(out: Path) -> None:
    with writing(out, "--out"):
        taken = out.exists() and (not out.is_dir() or any(out.iterdir()))
    if taken:
        raise InputError(f"--out {shown(out)}: it is there already; name a folder that is not")


def _lamps(words: Sequence[str]) -> dict[str, tuple[float, float, float]]:
    found = {}
    for word in words:
        name, _, values = word.rpartition("=")
        try:
            r, g, b = (float(x) for x in values.split(","))
            if not name:
                raise ValueError(word)
        except ValueError as error:
            raise InputError(f"--lamp {shown(word)}: it is not NAME=R,G,B with three numbers") from error
        r, g, b = (number(x, f"--lamp {shown(name)}: its radiance", 0.0, RADIANCE) for x in (r, g, b))
        found[name] = (r, g, b)
    return found


def _check_place(view: View, places: Sequence[Path]) -> None:
    """Masks and maps, too, lie where the source is: a camera file of others links to nothing else."""
    for file in filter(None, (view.mask, *view.maps.values(), view.spread)):
        if not any(Path(os.path.abspath(file)).is_relative_to(place) for place in places):
            raise InputError(f"{shown(file)}: its name in the camera file leads out of the folder {shown(places[0])}")


def _placed(settings: ImportSettings, views: Split) -> Float64Array:
    """What takes the meshes to the frame of the cameras."""
    if settings.axes is not None:
        if settings.up is not None:
            raise InputError("--axes: it says where all axes of the mesh go, so --up has nothing to say; leave one out")
        return axes(settings.axes) @ np.diag([settings.scale] * 3 + [1.0])
    if settings.up is None:
        return np.diag([settings.scale] * 3 + [1.0])
    to = held_up([*views.train, *views.test])
    say(f"{settings.up} of the mesh is turned to {to}, which the cameras hold up")
    return turned(settings.up, to, settings.scale)


def _upright(file: MeshFile, views: Split) -> MeshFile:
    """A file that says which axis points up, turned to the one that the cameras hold up."""
    if file.up is None:
        return file
    said = f"{shown(file.path)}: its upAxis is {file.up.upper()}"
    try:
        to = held_up([*views.train, *views.test])
    except InputError:
        return replace(file, notes=(*file.notes, f"{said}, and the cameras hold no axis up: it stays as it is"))
    if to == file.up:
        return file
    turn = turned(file.up, to, 1.0)
    return replace(
        file,
        meshes=[moved_mesh(mesh, turn) for mesh in file.meshes],
        lights=tuple(moved_light(light, turn) for light in file.lights),
        environment=None if file.environment is None else turned_map(file.environment, turn),
        notes=(*file.notes, f"{said}: it is turned to {to}, which the cameras hold up (--up says otherwise)"),
    )


def _whole_surfaces(file: MeshFile, width: float) -> MeshFile:
    """A file whose holes up to a width are closed, which it says."""
    closed = close_holes(file.meshes, width)
    left = "" if len(closed.open) == 0 else f"; {len(closed.open)} stay open, {closed.open[0]:.3g} wide or more"
    said = f"{shown(file.path)}: {closed.count} holes of {closed.area:.3g} square units are closed{left}"
    whole = file.linkable and closed.count == 0
    return replace(file, meshes=closed.meshes, linkable=whole, notes=(*file.notes, said))


def check_room(part: Path) -> Scene:
    """Read a folder as a fit does, and say what is to be said of its surfaces; a light may still be missing."""
    scene = read_folder(part)
    if scene.features.has_light:
        scene.check()
    say(*surface_notes(scene))
    return scene


def _say(room: RoomParts, meshes: Sequence[Mesh], out: Path) -> None:
    say_pictures()
    views = [*room.views.train, *room.views.test]
    sizes = dict.fromkeys(f"{view.camera.width} x {view.camera.height}" for view in views)
    held = f", {len(room.views.test)} of them held out" if room.views.test else ""
    print(f"{shown(out)}: {len(views)} photographs of {' or '.join(sizes)} pixels{held}")
    say(*room.views.notes, *(note for file in room.meshes for note in file.notes))
    if not meshes:
        print("no --mesh was given: put a scene.xml with geometry and lights into the folder")
        return
    low, high = bounds_of(room)
    print(f"{_size(meshes)}, ({place_text(low)}) to ({place_text(high)})")
    eyes = np.stack([view.camera.to_world[:3, 3] for view in views])
    inside = ((eyes >= low) & (eyes <= high)).all(1)
    least, most = (place_text(corner) for corner in (eyes.min(0), eyes.max(0)))
    print(f"cameras between ({least}) and ({most}), {int(inside.sum())} of {len(eyes)} inside")
    if 2 * inside.sum() < len(eyes):
        say("warning: most cameras lie outside of the mesh's box; check --up, --axes and --scale")
    if shining := lamp_names(meshes, room.lights):
        print(f"lamps: {listed(shining)}")
    elif room.environment is None and room.sky is None:
        names = listed(mesh.name for mesh in meshes)
        say(
            f"warning: nothing in the room is said to shine: give --lamp NAME=R,G,B (meshes: "
            f"{names}), a material with Ke in the OBJ file's MTL, or "
            "--environment; a fit with scan.yaml finds what shines in the photographs"
        )
        print(f"neurad fit --config scan.yaml --data.root {shown(out)}")
        return
    print(f"neurad fit --config scene.yaml --data.root {shown(out)}")


def _size(meshes: Sequence[Mesh]) -> str:
    return f"{len(meshes)} mesh{'' if len(meshes) == 1 else 'es'}, {sum(len(mesh.faces) for mesh in meshes)} triangles"


def lamp_names(meshes: Sequence[Mesh], lights: Sequence[PunctualLight]) -> list[str]:
    """What to call everything that shines but the environment."""
    shining = [mesh.name for mesh in meshes if mesh.radiance is not None]
    return [*shining, *(f"{light.name} ({light.kind})" for light in lights)]


def say_scene(
    out: Path, meshes: Sequence[Mesh], cameras: int, notes: Sequence[str], lines: Sequence[str], photographs: int
) -> None:
    """What a folder has of a scene that came with its own surfaces, further ``lines``, and what can be done with it."""
    say_pictures()
    print(f"{shown(out)}: {_size(meshes)}, {cameras} cameras")
    say(*notes)
    for line in lines:
        print(line)
    if photographs:
        print(f"{photographs} photographs; a fit holds out every {HOLD_OUT}th by name (--data.hold_out)")
        print(f"neurad fit --config scene.yaml --data.root {shown(out)}")
    elif cameras:
        print("no --images were given: it can be rendered, and fitted when it has photographs and a camera file")
        print(f"neurad render --root {shown(out)} --out pictures")
    else:
        print("neither cameras nor --images: put a transforms_train.json and photographs into the folder")
