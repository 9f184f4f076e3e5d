"""``neurad render``: pictures and material maps of a scene's views from its own, known materials."""

from __future__ import annotations

import argparse
from pathlib import Path

from neurad.core.ranges import Count, Positive, option


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--scene", help="name of a built-in scene: kitchen, patterns, cornell, cube, furnace or sphere")
    source.add_argument("--root", help="scene folder with scene.xml and transforms_*.json")
    parser.add_argument("--out", required=True, type=Path, help="folder to write; it gets images/, albedo/, roughness/")
    parser.add_argument(
        "--integrator", default="path",
        help="a method: path (default), prb, direct, radiometric, debiased. The last two are neural radiosity: a "
             "radiance field is trained first, then images/ shows the method, images_lhs/ the field itself",
    )  # fmt: skip
    parser.add_argument(
        "--steps", type=option(Count), default=2000, help="training steps of the radiance field (default: 2000)"
    )
    parser.add_argument(
        "--seconds", type=option(Positive), help="longest training of the radiance field (default: no limit)"
    )
    parser.add_argument("--views", choices=("train", "test", "all"), default="all", help="which views (default: all)")
    parser.add_argument(
        "--spp", type=option(Count), default=256, help="samples per pixel of the pictures (default: 256)"
    )
    parser.add_argument(
        "--map-spp", type=option(Count), default=64, help="samples per pixel of the material maps (default: 64)"
    )
    parser.add_argument(
        "--size", type=option(Count), help="width of the pictures in pixels (default: that of the views)"
    )
    parser.add_argument(
        "--max-depth", type=option(Count), help="longest path, 2 is direct light (default: that of the scene)"
    )
    parser.add_argument("--tracer", default="embree", help="embree (default), open3d or warp")
    parser.add_argument("--overwrite", action="store_true", help="write over files that are there")


def run(options: argparse.Namespace) -> None:
    """Render every view with the scene's true materials.

    Raises:
        InputError: unknown scene or method, unreadable files, a bad number, or a file that would be overwritten.
    """
    from dataclasses import fields

    from neurad.runs.render import RenderSettings, render_views

    render_views(RenderSettings(**{f.name: getattr(options, f.name) for f in fields(RenderSettings)}))
