"""``neurad data``: a scene folder from what other programs write."""

from __future__ import annotations

import argparse
from pathlib import Path

from neurad.core.ranges import Positive, option

KINDS = ("nerfstudio", "colmap", "polycam", "fipt", "gltf")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    parser.add_argument("kind", choices=KINDS, help="what SRC is")
    parser.add_argument("source", metavar="SRC", type=Path, help="folder or file that the other program has written")
    parser.add_argument("--out", required=True, type=Path, help="scene folder to make; it must not be there yet")
    parser.add_argument(
        "--mesh", type=Path, nargs="+", default=[],
        help="the room's surfaces: OBJ, PLY, STL, glTF or USD (default: scene.obj of FIPT's data)",
    )  # fmt: skip
    parser.add_argument(
        "--images",
        type=Path,
        help="folder of the photographs as EXR, if they do not lie beside those that SRC names; of a glTF "
        "scene each has the name of its camera",
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
    parser.add_argument("--copy", action="store_true", help="copy photographs and meshes instead of linking to them")


def run(options: argparse.Namespace) -> None:
    """Make the scene folder.

    Raises:
        InputError: a file is missing or broken, or the folder is there already.
    """
    from dataclasses import fields

    from neurad.scene.import_room import ImportSettings, import_room

    settings = ImportSettings(**{f.name: getattr(options, f.name) for f in fields(ImportSettings)})
    if settings.kind == "gltf":
        from neurad.scene.import_gltf import import_gltf

        import_gltf(settings)
    else:
        import_room(settings)
