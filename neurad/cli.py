"""The ``neurad`` command. Nothing heavy is imported before the verb is known, so that help answers at once."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from collections.abc import Iterator
from contextlib import nullcontext
from typing import NoReturn

from neurad.core.errors import InputError
from neurad.runtime import clock
from neurad.runtime.allocator import imports_kept, keep_freed_memory

LIGHTNING_VERBS = {
    "fit": "recover albedo and roughness from photographs",
    "validate": "score a fitted run on its held-out views",
    "test": "the same, and write every held-out view (EXR, PNG) and metrics.json",
    "predict": "write the held-out views without scoring them",
}
OWN_VERBS = {
    "render": ("neurad.commands.render", "render a scene's views from its own, known materials"),
    "compare": ("neurad.commands.compare", "run several methods with one budget and report error against cost"),
    "stress": ("neurad.commands.stress", "check stiff and extreme cases against known answers, a row each"),
    "bench": ("neurad.commands.bench", "measure what a training step, a method or a peer costs"),
}
"""Verbs beyond Lightning's: the module with ``add_arguments(parser)`` and ``run(options)``, and what it does."""

HELP = """usage: neurad VERB [--config NAME.yaml ...] [--KEY VALUE ...]

Inverse rendering under global illumination with a neural radiometric prior.

verbs:
{verbs}

examples:
  neurad fit --config kitchen.yaml                         the built-in demo, on a CPU
  neurad fit --config scene.yaml --data.root DIR           a scene of your own
  neurad fit --ckpt_path last                              continue the newest run
  neurad test                                              pictures and scores of the newest run
  tensorboard --logdir lightning_logs                      curves and pictures while it runs

Several --config overlay each other; a name that is no file is looked up among the shipped configs.
Every setting can be given as --KEY VALUE; `neurad VERB --help` lists them all.
"""


class _Parser(argparse.ArgumentParser):
    """A parser whose complaints are one sentence like everybody else's."""

    def error(self, message: str) -> NoReturn:
        """Raise what the parser found wrong."""
        raise InputError(message)


def help_text() -> str:
    """What ``neurad -h`` prints."""
    verbs = {**LIGHTNING_VERBS, **{verb: text for verb, (_, text) in OWN_VERBS.items()}}
    return HELP.format(verbs="\n".join(f"  {verb:<10}{text}" for verb, text in verbs.items()))


def main(args: list[str] | None = None) -> None:
    """Run the command line.

    Args:
        args: arguments after the program's name; those of the process if None.

    Raises:
        SystemExit: with 2 after one sentence on stderr if the input is bad, with 130 after Ctrl-C.
    """
    if args is not None:
        clock.restart()
    words = list(sys.argv[1:] if args is None else args)
    try:
        _dispatch(words, own_process=args is None)
    except InputError as error:
        _fail(str(error))
    except KeyboardInterrupt:
        print("neurad: interrupted", file=sys.stderr)
        raise SystemExit(130) from None
    except Exception as error:
        cause = next((e for e in _chain(error) if isinstance(e, InputError)), None)
        if cause is None:
            raise
        _fail(str(cause))


def _dispatch(words: list[str], own_process: bool) -> None:
    if not words or words[0] in ("-h", "--help", "help"):
        print(help_text(), end="")
        return
    verb, rest = words[0], words[1:]
    if verb == "--version":
        import neurad

        print(f"neurad {neurad.__version__}")
    elif verb in OWN_VERBS:
        _prepare()
        module, text = OWN_VERBS[verb]
        command = importlib.import_module(module)
        parser = _Parser(prog=f"neurad {verb}", description=text[:1].upper() + text[1:] + ".")
        command.add_arguments(parser)
        # A verb that passes settings on to others takes its words apart itself.
        command.run(command.parse(parser, rest) if hasattr(command, "parse") else parser.parse_args(rest))
    elif verb in LIGHTNING_VERBS:
        _prepare()
        with imports_kept() if own_process else nullcontext():
            from neurad.runs import lightning as train

            classes = _classes()
        train.run(verb, rest, *classes)
    else:
        raise InputError(f"{verb}: no such verb, there are {', '.join([*LIGHTNING_VERBS, *OWN_VERBS])}")


def _prepare() -> None:
    """What must be set before torch is imported."""
    keep_freed_memory()
    # Threads that spin while they wait collapse as soon as another process wants the same cores.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")


def _classes() -> tuple[type, type]:
    from datamodules.scene_data import SceneData
    from neurad.training.inverse import InverseRenderer

    return InverseRenderer, SceneData


def _chain(error: BaseException | None) -> Iterator[BaseException]:
    """The error and everything that led to it."""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def _fail(sentence: str) -> None:
    print(f"neurad: error: {' '.join(sentence.split())}", file=sys.stderr)
    raise SystemExit(2)
