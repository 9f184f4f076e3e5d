"""The run that the viewer's tests look at."""

import pytest
from helpers.tiny_fit import few_views, fit, run_folder, write_tiny_config


@pytest.fixture(scope="session")
def viewed_run(tmp_path_factory):
    """Folder of a fit of a moment in the built-in room with two lamps; it has error bars."""
    folder = tmp_path_factory.mktemp("viewed")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        few_views(patch, "patterns", 4)
        write_tiny_config(
            base="patterns.yaml", data={"patches": 128}, trainer={"max_steps": 60},
            model={"roughness": {"structure": "auto"}},
        )  # fmt: skip
        fit()
    return folder / run_folder()
