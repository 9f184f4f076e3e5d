"""The ``neurad`` command. Nothing heavy is imported before the verb is known, so that help answers at once."""

import argparse
import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import NoReturn

from neurad.commands import Verb, check, compare, data, export, new, render, view
from neurad.core.errors import InputError
from neurad.core.suggest import did_you_mean
from neurad.runs.trust import split_words
from neurad.runtime import clock, progress
from neurad.runtime.allocator import imports_kept, keep_freed_memory
from neurad.runtime.files import reason
from neurad.runtime.lean_imports import import_lightning
from neurad.runtime.streams import flush_output, open_closed_streams

LIGHTNING_VERBS = {
    "fit": "recover albedo and roughness from photographs",
    "validate": "score a fitted run on its held-out views",
    "test": "score it with more samples, and write every held-out view (EXR, PNG), scores and report.html",
    "predict": "write the held-out views without scoring them",
}


def _benchmark(verb: str) -> Verb:
    """A verb that measures the program, which is refused where only the installed package is there."""
    if not (Path(__file__).resolve().parent.parent / "benchmarks" / "__init__.py").is_file():
        raise InputError(
            f"{verb}: the benchmarks are not part of the installed package; run it in a checkout of neurad's"
            " repository, installed with pip install -e ."
        )
    from benchmarks.bench import verb as bench
    from benchmarks.stress import verb as stress

    return bench if verb == "bench" else stress


OWN_VERBS: dict[str, tuple[Callable[[], Verb], str]] = {
    "render": (lambda: render, "render a scene, or what a run recovered, from any camera and under any light"),
    "data": (lambda: data, "make a scene folder of what Blender, glTF, COLMAP, nerfstudio, Polycam or FIPT have"),
    "check": (lambda: check, "look for what is wrong in a scene folder before a fit learns from it, with pictures"),
    "export": (lambda: export, "write what a run recovered for Mitsuba, Blender and glTF viewers"),
    "view": (lambda: view, "look at a run in the browser: any camera, lamps dimmed, materials read out"),
    "compare": (lambda: compare, "run several methods with one budget and report error against cost"),
    "new": (lambda: new, "write a class, a config and a test to begin a method, field or reader of your own with"),
    "stress": (
        lambda: _benchmark("stress"),
        "check stiff and extreme cases against known answers, a row each (in a checkout)",
    ),
    "bench": (lambda: _benchmark("bench"), "measure what a training step, a method or a peer costs (in a checkout)"),
}
"""Verbs beyond Lightning's: what gives the verb's module, and what the verb does."""

HELP = """usage: neurad VERB [--config NAME.yaml ...] [--KEY VALUE ...]

neurad recovers what the surfaces of a room are made of: their albedo (the colour that they reflect) and roughness
(0 is a mirror, 1 is chalk), from the geometry, the lights and photographs. Light that bounces from wall to wall is
accounted for.

start here:
  neurad fit --config kitchen.yaml                         the built-in demo: four minutes on two CPU cores
  neurad test                                              pictures and scores of the newest run, with report.html
  neurad view                                              the newest run in the browser, lamps dimmed, points read out
  neurad check --root DIR                                  whether a room of your own is sound, with pictures
  neurad fit --config scene.yaml --data.root DIR           fit it (DIR: scene.xml or scene.glb, cameras, photographs)
  neurad fit --ckpt_path last --trainer.max_time 20m       go on with the newest run, up to 20 minutes in all
  neurad export --out room                                 what it found, for Blender, glTF viewers and Mitsuba

verbs:
{verbs}

what comes out is in lightning_logs/version_N, and the last lines of fit and test name it:
  report.html            what was recovered, how well, and where not to trust it
  images/                renderings, albedo and roughness of held-out views (EXR, PNG), and their error bars
  metrics.csv, .json     the scores; `tensorboard --logdir lightning_logs` draws them while a fit runs

how far to trust it:
  Scores are of views that the fit never saw: 20 dB is a typical error of 0.1, 30 dB of 0.03, 40 dB of 0.01. What is
  not above the best constant beside it was not recovered. Surfaces that no photograph shows are guesses (scores named
  _seen leave them out), and so is roughness where no photograph shows a highlight.

Several --config overlay each other, the last one on top; a name that is no file is looked up among the shipped
configs. Every setting can be given as --KEY VALUE: `neurad fit --help` has them all in words, `neurad fit --help spp`
those with spp in their name, `neurad VERB --help` the options of the other verbs. Times are written 60s, 4m or 1h30m.
"""


_WORD = 300
"""Characters of the longest word, a path for instance, that an error message shows whole."""
_LINE = 3000
"""Characters of the longest error message."""


class _Parser(argparse.ArgumentParser):
    """A parser that raises its error messages, so that they are printed in one sentence like all others."""

    def error(self, message: str) -> NoReturn:
        """Raise the message, with the option or choice that was probably meant."""
        if unknown := re.match(r"unrecognized arguments: (--[^\s=]+)", message):
            message += did_you_mean(unknown[1], self._option_string_actions)
        elif chosen := re.search(r"invalid choice: '([^']+)' \(choose from (.*)\)$", message):
            message += did_you_mean(chosen[1], re.findall(r"[\w-]+", chosen[2]))
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
            with progress.opened("starting"):
                _dispatch(words, own_process=args is None)
        finally:
            flush_output()
    except (Exception, KeyboardInterrupt) as error:
        causes = [*_chain(error)]
        # A package whose import Ctrl-C ends raises something else because of it.
        if any(isinstance(cause, KeyboardInterrupt) for cause in causes):
            print("neurad: interrupted", file=sys.stderr)
            raise SystemExit(130) from None
        sentence = str(error) if isinstance(error, InputError) else _sentence(causes)
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
        if _help_of(verb, rest):
            return
        _prepare()
        with imports_kept() if own_process else nullcontext():
            import_lightning()
            from datamodules.scene_data import SceneData
            from neurad.runs import lightning
            from neurad.training.inverse import InverseRenderer
        lightning.run(verb, rest, InverseRenderer, SceneData)
    else:
        verbs = [*LIGHTNING_VERBS, *OWN_VERBS]
        raise InputError(f"{verb}: no such verb" + (did_you_mean(verb, verbs) or f", there are {', '.join(verbs)}"))


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
    for key, value, said in split_words(words):
        if not key.startswith("--") or not ("." in key or key == "--seed_everything"):
            own += said
        else:
            settings.append(key if value is None else f"{key}={value}")
    return own, settings


def _help_of(verb: str, words: Sequence[str]) -> bool:
    """Print the help of one of Lightning's verbs if it is asked for; whether it was."""
    place = next((i for i, word in enumerate(words) if word in ("-h", "--help")), None)
    if place is None:
        return False
    from datamodules.settings import DataSettings
    from neurad.runs.settings_help import help_text

    names = [word for word in words[place + 1 :] if not word.startswith("-")]
    print(help_text(verb, LIGHTNING_VERBS[verb], DataSettings, names), end="")
    return True


def _prepare() -> None:
    """What must be set and looked at before torch and Lightning are imported."""
    from neurad.runs.trainer_settings import check_environment

    check_environment()
    keep_freed_memory()
    # Threads that spin while they wait collapse as soon as another process wants the same cores.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")


def _chain(error: BaseException | None) -> Iterator[BaseException]:
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
