"""From a glTF scene to a scene folder: ``neurad data gltf``."""

from neurad.core.errors import InputError
from neurad.formats.cameras.nerf import Split
from neurad.formats.gltf.file import GltfFile
from neurad.formats.gltf.read import ENDINGS, ENVIRONMENT, read_gltf
from neurad.formats.import_room import (
    ImportSettings,
    check_room,
    lamp_names,
    only_file,
    photographed,
    places_of,
    say_scene,
    whole,
)
from neurad.formats.room_folder import write_views
from neurad.runtime.files import place, writing
from neurad.runtime.reading import listed, regular_file, shown


def import_gltf(settings: ImportSettings) -> None:
    """Make the scene folder, whole or not at all, and say what is in it.

    Raises:
        InputError: a file is missing or broken, the scene uses what cannot be rendered, photographs and cameras do not
            fit, an option does not apply, or the folder is there already.
    """
    out, images, environment = places_of(settings, "a glTF scene")
    source = only_file(settings.source, ENDINGS, "glTF")
    if source.suffix.lower() not in ENDINGS:
        raise InputError(f"{shown(source)}: it is no glTF file ({' or '.join(ENDINGS)})")
    room = read_gltf(source)
    views = Split([], [])
    if images is not None:
        if not room.cameras:
            raise InputError(f"{shown(source)}: it has no perspective camera, so that no photograph can belong to it")
        views = photographed(room.cameras, images)
    with whole(out) as part:
        with writing(part, "--out"):
            name = f"scene{source.suffix.lower()}"
            place(source, part / name, settings.copy)
            for beside in dict.fromkeys(GltfFile(source).files()):
                (part / beside).parent.mkdir(parents=True, exist_ok=True)
                place(regular_file(source.parent / beside), part / beside, settings.copy)
            if environment is not None:
                place(environment, part / ENVIRONMENT, settings.copy)
            write_views(views, part, settings.copy)
        if views.train or room.cameras:
            check_room(part)
    notes, shining = [*room.notes, *views.notes], lamp_names(room.meshes, room.lights)
    if not shining and environment is None:
        notes.append(
            "warning: nothing in the room shines, so it cannot be fitted yet: give materials an emission, or "
            "--environment"
        )
    lines = [f"lamps: {listed(shining)}"] if shining else []
    say_scene(out, room.meshes, len(room.cameras), notes, lines, len(views.train))
