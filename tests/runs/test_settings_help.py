"""``neurad fit --help``: every setting, with its words, at once."""

import inspect
import subprocess
import sys
import time

import pytest
from helpers.tiny_fit import fails, write_tiny_config

from datamodules.settings import DataSettings
from neurad.cli import main
from neurad.runs import lightning
from neurad.runs.settings_help import GROUPS, METHOD, all_settings, method_settings

ALL = {"data": DataSettings, **GROUPS}


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
    return {
        setting.key: setting for group in all_settings({"data": DataSettings, **GROUPS}).values() for setting in group
    }


def of_parser(parser):
    """Keys of our settings that the parser reads, groups left out."""
    keys = {dest for dest in parser if dest.partition(".")[0] in ALL and "." in dest and not dest.endswith(".help")}
    return {key for key in keys if not any(other.startswith(f"{key}.") for other in keys)}


def test_every_setting_of_the_parser_is_there_with_words(parser, settings):
    assert settings.keys() == of_parser(parser)
    assert len(settings) > 80
    assert [key for key, setting in settings.items() if len(setting.words) < 10] == []  # 100 % have words


def test_defaults_are_those_of_the_parser(parser, settings):
    for key, setting in settings.items():
        if key != METHOD:
            default = parser[key].default
            default = list(default) if isinstance(default, tuple) else default
            assert setting.default is inspect.Parameter.empty or setting.default == default, key


def test_methods_are_those_that_are_shipped():
    from neurad.runs.configs import shipped_methods

    found = method_settings()
    named = {path for heading in found for path in heading.removeprefix(f"{METHOD}.class_path ").split(" or ")}
    assert named == {method["class_path"] for method in shipped_methods().values()}
    for heading, settings in found.items():
        assert all(len(setting.words) > 10 for setting in settings), heading
    (of_prb,) = (settings for heading, settings in found.items() if "PRB" in heading)
    (depth,) = (setting for setting in of_prb if setting.key == f"{METHOD}.init_args.max_depth")
    assert (depth.default, depth.kind) == (16, "whole number, at least 1 or null")


@pytest.mark.main
@pytest.mark.parametrize("verb", ["fit", "predict"])
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
    main(["fit", "--help", "method"])
    assert f"--{METHOD}.init_args.first_prob 0.5    (number, above 0 and at most 1)" in capfd.readouterr().out
    main(["fit", "--help", "first_prob"])
    assert f"--{METHOD}.init_args.first_prob" in capfd.readouterr().out
    assert "did you mean spp" in fails(capfd, "fit", "--help", "sppp")


@pytest.mark.main
def test_help_of_the_trainer_says_what_has_no_effect(capsys):
    main(["fit", "--help-trainer"])
    out = capsys.readouterr().out
    assert "--trainer.accelerator auto" in out
    assert "It has no effect here: gradients are clipped by --model.optimization.clip." in " ".join(out.split())
    assert "--model." not in out.replace("--model.optimization.clip", "")
