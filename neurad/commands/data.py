"""``neurad data``: a scene folder from what other programs write, and EXR files from brackets."""

import argparse
import re
from pathlib import Path

from neurad.core.errors import InputError
from neurad.core.ranges import Count, Positive, option
from neurad.core.suggest import did_you_mean

KINDS = ("nerfstudio", "colmap", "polycam", "fipt", "gltf", "blender")
MERGE = "hdr"
_WAYS = {
    "metashape agisoft photoscan": "it exports cameras in COLMAP's format (File, Export, Export Cameras), which "
    "`neurad data colmap` reads, or `ns-process-data metashape` makes what `neurad data nerfstudio` reads",
    "realitycapture realityscan": "it exports its registration in COLMAP's format, which `neurad data colmap` reads, "
    "or `ns-process-data realitycapture` makes what `neurad data nerfstudio` reads",
    "record3d odm aria": "`ns-process-data {}` of nerfstudio makes what `neurad data nerfstudio` reads",
    "kiri kiriengine spectacularai nerfcapture instantngp ngp nerf": "its transforms.json is read by `neurad data "
    "nerfstudio`",
    "glomap hloc pycolmap 3dgs": "its model is COLMAP's: `neurad data colmap` reads it",
    "glb fbx dae 3dsmax maya cinema4d houdini unity unreal sketchup revit usd obj ply stl": "export the scene with its "
    "cameras as glTF (`neurad data gltf`); a mesh alone goes to --mesh, beside cameras of COLMAP or nerfstudio",
    "mitsuba": "a folder with Mitsuba's scene.xml and camera files is a scene folder as it is, for --data.root",
    "iris": "`neurad data fipt` reads it",
}
"""How what other programs write comes in, by their names."""
_ANY_OTHER = (
    "programs that find cameras export them in COLMAP's format (`neurad data colmap`) or as nerfstudio's "
    "transforms.json (`neurad data nerfstudio`)"
)


def _kind(word: str) -> str:
    """One of :data:`KINDS`, or hdr."""
    wanted = word.lower()
    if wanted in (*KINDS, MERGE):
        return wanted
    plain = re.sub(r"[-_ .]", "", wanted)
    way = next((way for names, way in _WAYS.items() if plain in names.split()), _ANY_OTHER).replace("{}", plain)
    near = did_you_mean(wanted, (*KINDS, MERGE)) if way is _ANY_OTHER else ""
    raise InputError(f"argument kind: {word} is none of {', '.join((*KINDS, MERGE))}{near or f': {way}'}")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    parser.add_argument(
        "kind",
        type=_kind,
        metavar=f"{{{','.join((*KINDS, MERGE))}}}",
        help="what SRC is; hdr merges brackets to linear EXR",
    )
    parser.add_argument(
        "source", metavar="SRC", type=Path, nargs="+",
        help="folder or file that the other program has written; for hdr the photographs, those of a view in a row",
    )  # fmt: skip
    parser.add_argument(
        "--out",
        required=True,
        type=Path,
        help="scene folder to make, which must not be there yet; for hdr that of the EXR",
    )
    parser.add_argument(
        "--mesh", type=Path, nargs="+", action="extend", default=[],
        help="the room's surfaces: OBJ, PLY, STL, glTF or USD (default: scene.obj of FIPT's data)",
    )  # fmt: skip
    parser.add_argument(
        "--images",
        type=Path,
        help="folder of the photographs as EXR, if they do not lie beside those that SRC names; of a glTF "
        "or Blender scene each has the name of its camera",
    )
    parser.add_argument(
        "--up", choices=("x", "y", "z", "-x", "-y", "-z"),
        help="axis of the mesh that points up; it is turned to the axis that the cameras hold up (default: as it is); "
             "write --up=-y for a negative one",
    )  # fmt: skip
    parser.add_argument(
        "--axes", metavar="AXES",
        help="axes of the mesh that become the cameras' x, y and z, such as zxy or x,-z,y; or a rotation, nine numbers "
             "row by row (default: as they are)",
    )  # fmt: skip
    parser.add_argument(
        "--scale", type=option(Positive), default=1.0, help="times the mesh's lengths, such as 0.01 for cm (default: 1)"
    )
    parser.add_argument(
        "--close-holes", type=option(Positive), metavar="WIDTH",
        help="close holes of the mesh up to this width, in its unit, such as 0.3; wider ones may be windows (default: "
             "none)",
    )  # fmt: skip
    parser.add_argument(
        "--lamp", action="append", default=[], metavar="NAME=R,G,B",
        help="a mesh or material that shines with this radiance; may be given several times",
    )  # fmt: skip
    parser.add_argument("--environment", type=Path, help="environment map that lights the room (EXR, +Y up)")
    parser.add_argument("--bracket", type=option(Count), help="hdr: photographs of each view (default: all are of one)")
    parser.add_argument(
        "--times", type=option(Positive), nargs="+", help="hdr: exposures of a view's photographs (default: EXIF's)"
    )
    parser.add_argument(
        "--response", help="hdr: linear, srgb (default), gamma=G or a file with the curve of PNG, JPEG and TIFF"
    )
    parser.add_argument(
        "--blender", help="blender: Blender's program, or a Python with bpy (default: the blender on the PATH)"
    )
    parser.add_argument("--copy", action="store_true", help="copy photographs and meshes instead of linking to them")


def run(options: argparse.Namespace) -> None:
    """Make the scene folder."""
    if options.kind == MERGE:
        _merge(options)
        return
    for name in ("bracket", "times", "response"):
        if getattr(options, name) is not None:
            raise InputError(f"--{name}: it is for neurad data hdr alone")
    if len(options.source) > 1:
        raise InputError(f"SRC: neurad data {options.kind} takes one folder, not {len(options.source)}")
    from dataclasses import fields

    from neurad.formats.import_room import ImportSettings, import_room

    values = {f.name: getattr(options, f.name) for f in fields(ImportSettings)}
    settings = ImportSettings(**{**values, "source": options.source[0]})
    if settings.blender is not None and settings.kind != "blender":
        raise InputError("--blender: it is for neurad data blender alone")
    if settings.kind == "blender":
        from neurad.formats.blender.import_blender import import_blender

        import_blender(settings)
    elif settings.kind == "gltf":
        from neurad.formats.gltf.import_gltf import import_gltf

        import_gltf(settings)
    else:
        import_room(settings)


def _merge(options: argparse.Namespace) -> None:
    """Merge brackets."""
    for name in ("mesh", "images", "up", "axes", "close_holes", "lamp", "environment", "copy", "blender"):
        if getattr(options, name):
            raise InputError(f"--{name.replace('_', '-')}: it is for scene folders, neurad data hdr makes EXR files")
    from neurad.images.hdr import MergeSettings, merge_brackets

    merge_brackets(MergeSettings(options.source, options.out, options.bracket or 0, options.times, options.response))
