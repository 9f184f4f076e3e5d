"""``neurad render``: pictures of a scene, or of what a run recovered, from any camera and under any light."""

import argparse
from pathlib import Path

from neurad.core.durations import seconds_of
from neurad.core.ranges import Count, Finite, Positive, option
from neurad.runs.trust import add_reader, add_trust


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    parser.add_argument("--scene", help="name of a built-in scene, with its own materials")
    parser.add_argument("--root", help="scene folder, with its own materials; of a run one of the same geometry")
    parser.add_argument(
        "--ckpt_path",
        help="run folder or checkpoint whose recovered materials are rendered (default: the newest run, where neither "
        "--scene nor --root is given)",
    )
    add_reader(parser)
    add_trust(parser)
    parser.add_argument("--camera", help="camera file (as transforms.json; it needs no photographs) instead of views")
    parser.add_argument("--edit", help="YAML: lamps off, scaled, coloured, moved; environment; materials; objects")
    parser.add_argument("--out", required=True, type=Path, help="folder to write; it gets images/, albedo/, roughness/")
    parser.add_argument(
        "--integrator",
        help="a method: path, prb, direct, radiometric, debiased. The last two are neural radiosity: a radiance field "
             "is trained first, then images/ shows the method, images_lhs/ the field itself (default: path, and of a "
             "run that is not changed its own)",
    )  # fmt: skip
    parser.add_argument(
        "--steps", type=option(Count), default=2000, help="training steps of the radiance field (default: 2000)"
    )
    parser.add_argument(
        "--seconds",
        type=option(Positive, seconds_of),
        metavar="TIME",
        help="longest training of the radiance field, such as 90s or 5m (default: no limit)",
    )
    parser.add_argument(
        "--views", choices=("train", "test", "all"), help="which views (default: all; of a run those held out)"
    )
    parser.add_argument(
        "--path", choices=("turntable", "pan", "fly"),
        help="a film instead: round the middle of the scene, round the first camera itself, or through all cameras",
    )  # fmt: skip
    parser.add_argument("--frames", type=option(Count), default=120, help="frames of the film (default: 120)")
    parser.add_argument("--fps", type=option(Count), default=30, help="frames a second (default: 30)")
    parser.add_argument("--movie", choices=("mp4", "png"), default="mp4", help="film or its frames (default: mp4)")
    parser.add_argument(
        "--exposure", type=option(Finite), help="of PNG pictures and films in stops (default: by the first picture)"
    )
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
    parser.add_argument("--tracer", default="embree", help="embree (default), open3d or warp; a run has its own")
    parser.add_argument("--overwrite", action="store_true", help="write over files that are there")


def run(options: argparse.Namespace) -> None:
    """Render views or a film."""
    from dataclasses import fields

    from neurad.runs.model_settings import own_reader
    from neurad.runs.render import RenderSettings, render_views

    options.reader = own_reader(options.reader, options.trust)
    if options.ckpt_path is None and options.scene is None and options.root is None:
        options.ckpt_path = "last"
    render_views(RenderSettings(**{f.name: getattr(options, f.name) for f in fields(RenderSettings)}))
