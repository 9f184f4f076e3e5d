"""Settings that are times take ``4m``, on the command line and in configs."""

from pathlib import Path

import pytest
import yaml
from helpers.tiny_fit import printed_config

from neurad.runs.times import in_tree, in_words


@pytest.mark.main
def test_times_of_the_command_line_and_of_configs(tiny, capsys):
    Path("mine.yaml").write_text(
        yaml.safe_dump({"base": "tiny.yaml", "trainer": {"max_time": "1h30m"}, "checkpoint": {"every_seconds": "2m"}})
    )
    found = printed_config(capsys, "--config", "mine.yaml")
    assert found["trainer"]["max_time"] == "00:01:30:00"
    assert found["checkpoint"]["every_seconds"] == 120.0
    found = printed_config(capsys, "--config", "mine.yaml", "--trainer.max_time", "90s")
    assert found["trainer"]["max_time"] == "00:00:01:30"


def test_what_the_parser_reads_stays_as_it_is():
    words = [
        "--trainer.max_time=00:00:04:00",
        "--trainer.max_time=null",
        "--data.root=4m",
        "--checkpoint.every_seconds=5",
    ]
    assert in_words(words) == words
    tree = {"trainer": {"max_time": None}, "data": {"root": "4m"}, "checkpoint": {"every_seconds": 5}}
    assert in_tree(tree, "config x") == tree
    assert in_words(["--trainer.max_time=04:00"]) == ["--trainer.max_time=00:00:04:00"]


def test_budgets_of_callbacks():
    entry = {"class_path": "TrainingBudget", "init_args": {"seconds": "2m"}}
    tree = in_tree({"trainer": {"callbacks": [entry, "other"]}}, "config x")
    assert tree["trainer"]["callbacks"] == [{**entry, "init_args": {"seconds": 120.0}}, "other"]
    assert entry["init_args"]["seconds"] == "2m"
