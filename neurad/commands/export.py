"""``neurad export``: what a run recovered, for Mitsuba, Blender and other programs."""

import argparse
from pathlib import Path

from neurad.core.ranges import Count, Texels, TextureSide, option, range_of, shown
from neurad.runs.trust import add_trust
from neurad.runtime.progress import say


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    parser.add_argument("--ckpt_path", help="run folder or checkpoint (default: the newest run in lightning_logs)")
    parser.add_argument(
        "--out",
        type=Path,
        help="folder to write, which is a scene folder itself; with --into a file (default: beside it)",
    )
    parser.add_argument(
        "--into", type=Path, metavar="FILE",
        help="the .blend or .glb that the room was read from: writes a copy of it, FILE_recovered, with the recovered "
             "textures on its own objects",
    )  # fmt: skip
    parser.add_argument(
        "--group",
        choices=("mesh", "material"),
        default="mesh",
        help="with --into: a texture for each mesh's part of a material (default), or one for each material",
    )
    parser.add_argument("--root", help="where the scene's folder is now, if it has moved since the fit")
    add_trust(parser)
    parser.add_argument(
        "--for", dest="target", choices=("blender", "gltf", "exact"), default="blender",
        help="whose base colours scene.glb gets, so that surfaces send back as much light there: Blender's Cycles "
             "(default), other glTF viewers, or unchanged",
    )  # fmt: skip
    parser.add_argument("--texels", type=_count, default=16_000_000, help="most texels in all, such as 16M (default)")
    parser.add_argument(
        "--size", type=option(TextureSide), help="side of every texture (default: what the photographs show)"
    )
    parser.add_argument(
        "--up",
        choices=("x", "y", "z", "-x", "-y", "-z"),
        help="axis that points up, with a minus as in --up=-y (default: as the cameras hold it)",
    )
    parser.add_argument("--copy", action="store_true", help="copy photographs and true maps instead of linking to them")
    parser.add_argument("--no-verify", dest="verify", action="store_false", help="write only, render nothing")
    parser.add_argument(
        "--spp", type=option(Count), default=16, help="samples a pixel in a pass of the verification (default: 16)"
    )
    parser.add_argument(
        "--blender",
        help="a Python with bpy, or Blender: verifies scene.glb with Cycles, too, and opens what --into names",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace the folder of an earlier export")


def _count(text: str) -> int:
    """A number that may end with k, M or G."""
    factor = {"k": 1e3, "M": 1e6, "G": 1e9}.get(text[-1:], 1)
    try:
        count = int(float(text[:-1] if factor != 1 else text) * factor)
    except (ValueError, OverflowError):
        raise argparse.ArgumentTypeError(f"'{shown(text)}' is not a number of texels, such as 16M") from None
    allowed = range_of(Texels)
    if allowed is not None and count not in allowed:
        raise argparse.ArgumentTypeError(f"{shown(count)} is out of range, it must be {allowed}")
    return count


def run(options: argparse.Namespace) -> None:
    """Export a run.

    Raises:
        InputError: no such run, or what :func:`neurad.export.run.export` says.
        SystemExit: with 1 if the verification finds a difference beyond its bounds.
    """
    from dataclasses import fields

    from neurad.core.errors import InputError
    from neurad.export.folder import check_out
    from neurad.export.into import check_free, export_into, place_beside
    from neurad.export.run import ExportSettings, export
    from neurad.runs.load import load_run

    if options.into is not None:
        options.out = options.out or place_beside(options.into)
    elif options.out is None:
        raise InputError("--out: name the folder to write")
    settings = ExportSettings(**{f.name: getattr(options, f.name) for f in fields(ExportSettings)})
    if settings.into is not None:
        check_free(settings.out, settings.into)
        loaded = load_run(options.ckpt_path, options.root, other_light=False, trust=options.trust)
        found = export_into(loaded.assembly, settings.into, settings, loaded.bars)
    else:
        check_out(settings.out, settings.overwrite)
        loaded = load_run(options.ckpt_path, options.root, other_light=False, trust=options.trust)
        found = export(loaded.assembly, loaded.checkpoint, settings, loaded.bars)
    if found:
        say(f"{settings.out}: {'; '.join(found)}")
        raise SystemExit(1)
