"""The ``neurad`` command. Nothing heavy is imported before the verb is known, so that help answers at once."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext, suppress
from typing import NoReturn

from neurad.commands import Verb
from neurad.core.errors import InputError
from neurad.runtime import clock
from neurad.runtime.allocator import imports_kept, keep_freed_memory
from neurad.runtime.files import reason
from neurad.runtime.streams import flush_output, open_closed_streams

LIGHTNING_VERBS = {
    "fit": "recover albedo and roughness from photographs",
    "validate": "score a fitted run on its held-out views",
    "test": "the same, and write every held-out view (EXR, PNG) and metrics.json",
    "predict": "write the held-out views without scoring them",
}


def _render() -> Verb:
    from neurad.commands import render

    return render


def _data() -> Verb:
    from neurad.commands import data

    return data


def _export() -> Verb:
    from neurad.commands import export

    return export


def _compare() -> Verb:
    from neurad.commands import compare

    return compare


def _stress() -> Verb:
    from neurad.commands import stress

    return stress


def _bench() -> Verb:
    from neurad.commands import bench

    return bench


OWN_VERBS: dict[str, tuple[Callable[[], Verb], str]] = {
    "render": (_render, "render a scene, or what a run recovered, from any camera and under any light"),
    "data": (_data, "make a scene folder of what nerfstudio, COLMAP, Polycam or FIPT have"),
    "export": (_export, "write what a run recovered for Mitsuba, Blender and glTF viewers"),
    "compare": (_compare, "run several methods with one budget and report error against cost"),
    "stress": (_stress, "check stiff and extreme cases against known answers, a row each"),
    "bench": (_bench, "measure what a training step, a method or a peer costs"),
}
"""Verbs beyond Lightning's: a function that imports the verb's module, and what the verb does."""

HELP = """usage: neurad VERB [--config NAME.yaml ...] [--KEY VALUE ...]

Inverse rendering under global illumination with a neural radiometric prior.

verbs:
{verbs}

examples:
  neurad fit --config kitchen.yaml                         the built-in demo, on a CPU
  neurad fit --config scene.yaml --data.root DIR           a scene of your own
  neurad fit --ckpt_path last                              continue the newest run
  neurad test                                              pictures and scores of the newest run
  tensorboard --logdir lightning_logs                      curves and pictures during a run

Several --config overlay each other, the last one on top; a name that is no file is looked up among the shipped
configs. Every setting can be given as --KEY VALUE; `neurad VERB --help` lists them all.
"""


_WORD = 300
"""Characters of the longest word, a path for instance, that an error message shows whole."""
_LINE = 3000
"""Characters of the longest error message."""


class _Parser(argparse.ArgumentParser):
    """A parser that raises its error messages, so that they are printed in one sentence like all others."""

    def error(self, message: str) -> NoReturn:
        """Raise the message."""
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
    open_closed_streams()
    words = list(sys.argv[1:] if args is None else args)
    try:
        try:
            _dispatch(words, own_process=args is None)
        finally:
            flush_output()
    except InputError as error:
        _fail(str(error))
    except KeyboardInterrupt:
        print("neurad: interrupted", file=sys.stderr)
        raise SystemExit(130) from None
    except Exception as error:
        sentence = _sentence([*_chain(error)])
        if not sentence:
            raise
        _fail(sentence)


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
        load, text = OWN_VERBS[verb]
        command = load()
        parser = _Parser(prog=f"neurad {verb}", description=text[:1].upper() + text[1:] + ".")
        command.add_arguments(parser)
        command.run(_parse(parser, rest))
    elif verb in LIGHTNING_VERBS:
        _prepare()
        with imports_kept() if own_process else nullcontext():
            from neurad.runs import lightning

            classes = _classes()
        lightning.run(verb, rest, *classes)
    else:
        raise InputError(_unknown(verb))


def _parse(parser: argparse.ArgumentParser, words: Sequence[str]) -> argparse.Namespace:
    """Options of a verb. One that starts fits (it has a default for ``settings``) gets what is meant for them apart."""
    if parser.get_default("settings") is None:
        return parser.parse_args(words)
    own, settings = split_settings(words)
    return parser.parse_args(own, argparse.Namespace(settings=settings, words=list(words)))


def split_settings(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """A verb's own arguments, and the settings of ``neurad fit`` among them as ``--key=value``.

    A setting has a dot in its key, such as ``--data.root DIR``, or is ``--seed_everything``.
    """
    own, settings = [], []
    queue = list(words)
    while queue:
        word = queue.pop(0)
        key = word.partition("=")[0]
        if not key.startswith("--") or not ("." in key or key == "--seed_everything"):
            own.append(word)
            continue
        if "=" not in word and queue and not queue[0].startswith("--"):
            word = f"{word}={queue.pop(0)}"
        settings.append(word)
    return own, settings


def _unknown(verb: str) -> str:
    """The sentence about a verb that does not exist, with the nearest that does."""
    from difflib import get_close_matches

    verbs = [*LIGHTNING_VERBS, *OWN_VERBS]
    near = get_close_matches(verb, verbs, 1)
    return f"{verb}: no such verb, " + (f"did you mean {near[0]}?" if near else f"there are {', '.join(verbs)}")


def _prepare() -> None:
    """What must be set and looked at before torch and Lightning are imported.

    Raises:
        InputError: a variable of the environment, which Lightning reads when it is imported, is no number.
    """
    from neurad.runs.trainer_settings import check_environment

    check_environment()
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


def _sentence(errors: Sequence[BaseException]) -> str:
    """What the user reads: of a mistake or, if there was none, of the system that refused a file; else nothing."""
    for error in errors:
        if isinstance(error, InputError):
            return str(error)
    for error in errors:
        if isinstance(error, OSError) and error.errno is not None:
            return f"{error.filename or 'standard output'}: {reason(error)}"
    return ""


def _printable(sentence: str) -> str:
    """One line for a terminal: what would steer it is escaped, and the middle of what is very long is left out."""
    words = ("".join(c if c.isprintable() else ascii(c)[1:-1] for c in word) for word in sentence.split())
    line = " ".join(word if len(word) <= _WORD else f"{word[: _WORD // 2]}...{word[-_WORD // 2 :]}" for word in words)
    return line if len(line) <= _LINE else f"{line[: _LINE // 2]} ... {line[-_LINE // 2 :]}"


def _fail(sentence: str) -> None:
    with suppress(OSError):  # standard errors may be on the same full disk
        flush_output()
    with suppress(OSError):
        print(f"neurad: error: {_printable(sentence)}", file=sys.stderr)
        sys.stderr.flush()
    raise SystemExit(2)
