"""``neurad fit --help``: every setting, with its words, at once."""

import importlib
import pkgutil
import subprocess
import sys
import time

import pytest
from helpers.tiny_fit import fails, write_tiny_config

from neurad.cli import LIGHTNING_VERBS, main
from neurad.runs import lightning
from neurad.runs.settings_source import GROUPS, METHODS, REQUIRED, SOURCES, all_settings, methods


@pytest.fixture(scope="module")
def parser(tmp_path_factory):
    """The parser that ``neurad fit`` really reads settings with."""
    found = {}

    def keep(self, parser, args):
        found["actions"] = {action.dest: action for action in self._subcommand_parsers["fit"]._actions}
        raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("parser"))
        write_tiny_config()
        patch.setattr(lightning.NeuradCLI, "parse_arguments", keep)
        with pytest.raises(SystemExit):
            main(["fit", "--config", "tiny.yaml"])
    return found["actions"]


@pytest.fixture(scope="module")
def settings():
    return {setting.key: setting for group in all_settings().values() for setting in group}


def of_parser(parser):
    """Keys of our settings that the parser reads, groups left out."""
    keys = {dest for dest in parser if dest.partition(".")[0] in GROUPS and "." in dest and not dest.endswith(".help")}
    return {key for key in keys if not any(other.startswith(f"{key}.") for other in keys)}


def test_every_setting_of_the_parser_is_there_with_words(parser, settings):
    ours = {key for key in settings if not key.startswith("model.method.init_args")}
    assert ours | {"model.method"} == of_parser(parser)
    assert len(ours) > 80
    assert [key for key, setting in settings.items() if len(setting.words) < 10] == []  # 100 % have words


def test_defaults_are_those_of_the_parser(parser, settings):
    for key, setting in settings.items():
        if key in parser and key != "model.method":
            default = parser[key].default
            default = list(default) if isinstance(default, tuple) else default
            assert setting.default is REQUIRED or setting.default == default, key


def test_methods_are_those_that_there_are():
    from neurad import integrators
    from neurad.integrators.method import Method
    from neurad.runs.render_subject import _methods

    for module in pkgutil.iter_modules(integrators.__path__):
        importlib.import_module(f"{integrators.__name__}.{module.name}")
    shipped = {method["class_path"] for method in _methods().values()}
    assert shipped <= methods().keys()
    known = {f"{sub.__module__}.{sub.__name__}" for sub in _subclasses(Method)}
    assert {name for name in known if name.startswith("neurad.integrators")} == methods().keys()
    assert (SOURCES / METHODS).is_dir()


def _subclasses(owner):
    for sub in owner.__subclasses__():
        yield sub
        yield from _subclasses(sub)


@pytest.mark.main
@pytest.mark.parametrize("verb", LIGHTNING_VERBS)
def test_help_puts_ours_first_and_leaves_the_trainer_out(capsys, verb):
    main([verb, "--config", "kitchen.yaml", "--help"])
    out = capsys.readouterr().out
    assert out.startswith(f"usage: neurad {verb}")
    assert out.index("--trainer.max_time") < out.index("--data.patches") < out.index("--model.sampling.spp")
    assert "--help-trainer" in out
    assert "--trainer.accumulate_grad_batches" not in out
    assert max(map(len, out.splitlines())) <= 120


def test_help_imports_nothing_heavy_and_answers_at_once():
    heavy = "{'torch', 'lightning', 'numpy'} & set(sys.modules)"
    code = f"import sys; from neurad.cli import main; main(['fit', '--help'])\nprint({heavy})"
    begin = time.monotonic()
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert time.monotonic() - begin < 20  # 0.3 s on an idle machine; the bound is for a crowded one
    assert done.stdout.endswith("set()\n")


@pytest.mark.main
def test_help_of_some_settings(capfd):
    main(["fit", "--help", "guide"])
    out = capfd.readouterr().out
    assert "--model.sampling.guide 16" in out
    assert "at least 0 and at most 32" in out
    assert "--model.sampling.spp" not in out
    assert "did you mean spp" in fails(capfd, "fit", "--help", "sppp")


@pytest.mark.main
def test_help_of_the_trainer_says_what_has_no_effect(capsys):
    main(["fit", "--help-trainer"])
    out = capsys.readouterr().out
    assert "--trainer.accelerator auto" in out
    assert "It has no effect here: gradients are clipped by --model.optimization.clip." in " ".join(out.split())
    assert "--model." not in out.replace("--model.optimization.clip", "")
