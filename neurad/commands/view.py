"""``neurad view``: a run in the browser."""

import argparse
from typing import Annotated

from neurad.core.ranges import Range, option
from neurad.runs.trust import add_trust
from neurad.runtime.progress import say

Port = Annotated[int, Range(0, 65535)]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    parser.add_argument("--ckpt_path", help="run folder or checkpoint (default: the newest run in lightning_logs)")
    parser.add_argument("--root", help="where the scene's folder is now, if it has moved since the fit")
    add_trust(parser)
    parser.add_argument(
        "--port", type=option(Port), help="where the page is, 0 for any free port (default: the first free from 8080)"
    )
    parser.add_argument(
        "--hints", metavar="FILE", help="where the page may write hints for another fit (--data.hints FILE), at its end"
    )


def run(options: argparse.Namespace) -> None:
    """Show a run until Ctrl-C."""
    from neurad.runtime.extras import needed

    with needed("viser", "view", "view: the page"):
        import viser  # noqa: F401

    from neurad.formats.hints import hints_file
    from neurad.inspect.server import check_port

    check_port(options.port)
    hints = None if options.hints is None else hints_file(options.hints)

    from neurad.inspect.viewer import Viewer
    from neurad.runs.load import load_run

    loaded = load_run(options.ckpt_path, options.root, trust=options.trust)
    say("preparing; the first time on a machine this compiles for a minute or two")
    viewer = Viewer(loaded, options.port, hints)
    print(f"open {viewer.address} in a browser; Ctrl-C ends", flush=True)
    try:
        viewer.run()
    except KeyboardInterrupt:
        pass
    finally:
        viewer.close()
