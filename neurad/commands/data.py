"""``neurad data``: a scene folder from what other programs write, and EXR files from brackets."""

from __future__ import annotations

import argparse
from pathlib import Path

from neurad.core.errors import InputError
from neurad.core.ranges import Count, Positive, option

KINDS = ("nerfstudio", "colmap", "polycam", "fipt", "gltf", "blender")
MERGE = "hdr"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    parser.add_argument("kind", choices=(*KINDS, MERGE), help="what SRC is; hdr merges brackets to linear EXR")
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
        "--scale", type=option(Positive), default=1.0, help="times the mesh's lengths, such as 0.01 for cm (default: 1)"
    )
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
    """Make the scene folder.

    Raises:
        InputError: a file is missing or broken, or the folder is there already.
    """
    if options.kind == MERGE:
        _merge(options)
        return
    for name in ("bracket", "times", "response"):
        if getattr(options, name) is not None:
            raise InputError(f"--{name}: it is for neurad data hdr alone")
    if len(options.source) > 1:
        raise InputError(f"SRC: neurad data {options.kind} takes one folder, not {len(options.source)}")
    from dataclasses import fields

    from neurad.scene.import_room import ImportSettings, import_room

    values = {f.name: getattr(options, f.name) for f in fields(ImportSettings)}
    settings = ImportSettings(**{**values, "source": options.source[0]})
    if settings.blender is not None and settings.kind != "blender":
        raise InputError("--blender: it is for neurad data blender alone")
    if settings.kind == "blender":
        from neurad.scene.import_blender import import_blender

        import_blender(settings)
    elif settings.kind == "gltf":
        from neurad.scene.import_gltf import import_gltf

        import_gltf(settings)
    else:
        import_room(settings)


def _merge(options: argparse.Namespace) -> None:
    """Merge brackets.

    Raises:
        InputError: an option of scene folders is given, or what :func:`merge_brackets` raises.
    """
    for name in ("mesh", "images", "up", "lamp", "environment", "copy", "blender"):
        if getattr(options, name):
            raise InputError(f"--{name}: it is for scene folders, neurad data hdr makes EXR files")
    from neurad.scene.hdr import MergeSettings, merge_brackets

    merge_brackets(MergeSettings(options.source, options.out, options.bracket or 0, options.times, options.response))
