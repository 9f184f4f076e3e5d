"""Short fits of a small Cornell box through the command line."""

import pytest
import torch
from helpers.small_fit import fit_small

from neurad.assembly.settings import Optimization
from neurad.training.schedule import learning_rate, rate_factor


def test_a_short_fit_finds_the_albedo(small):
    """Measured 12.3 dB after 7 iterations; the best constant has 12.9."""
    small(glossy=False)
    rows, _ = fit_small("--trainer.max_steps=240", "--evaluation.every_n_steps=120")
    assert [row["iteration"] for row in rows] == ["120", "240"]
    last = {key: float(value) for key, value in rows[-1].items() if value}
    print(last["albedo_psnr"])
    assert last["albedo_psnr"] > 24
    assert last["albedo_psnr_constant"] < 14


@pytest.mark.parametrize(("glossy", "optimizers"), [(True, 3), (False, 2)])
def test_max_steps_counts_iterations_and_roughness_is_built_where_there_is_some(small, glossy, optimizers):
    small(glossy)
    rows, state = fit_small("--trainer.max_steps=7")
    assert state["neurad"]["iteration"] == state["global_step"] == 7
    assert [row["iteration"] for row in rows] == ["7"]
    assert len(state["optimizer_states"]) == optimizers
    assert {s["state"][0]["step"].item() for s in state["optimizer_states"]} == {7.0}
    assert any(name.startswith("materials.fields.roughness") for name in state["state_dict"]) == glossy


def test_a_run_takes_the_units_of_light_from_its_photographs(small):
    """Light and photographs times 2^20, exact in floats: ten iterations give the same materials."""
    found = []
    for unit in (1.0, 2.0**20):
        small(True, unit)
        found.append(fit_small("--trainer.max_steps=10")[1]["state_dict"])
    assert found[1]["radiance.scale"] == found[0]["radiance.scale"] * 2**20
    for name, value in found[0].items():
        if name.startswith("materials."):
            torch.testing.assert_close(found[1][name], value, rtol=1e-4, atol=1e-6)


# ---- learning rates over a run


SETTINGS = Optimization(albedo=1e-2, roughness=2e-3, roughness_warmup=100)


def test_rates_rise_and_fall() -> None:
    """A linear rise, then half a cosine from 1 to a fiftieth."""
    assert [rate_factor(SETTINGS, i, 0.0) for i in (0, 1, 9, 19, 20)] == [0.05, 0.1, 0.5, 1.0, 1.0]
    assert [rate_factor(SETTINGS, 50, p) for p in (0.5, 1.0)] == pytest.approx([0.51, 0.02])


def test_roughness_may_rise_later_than_the_others() -> None:
    factor = rate_factor(SETTINGS, 19, 0.0)
    assert learning_rate(SETTINGS, "albedo", 9, factor) == 1e-2
    assert learning_rate(SETTINGS, "roughness", 9, factor) == pytest.approx(2e-4)
    assert learning_rate(SETTINGS, "roughness", 99, factor) == 2e-3
    assert learning_rate(Optimization(roughness=2e-3), "roughness", 30, factor) == 2e-3
    held = [learning_rate(SETTINGS, "roughness", i, factor, 48) for i in (47, 48, 147)]
    assert held == pytest.approx([0.0, 2e-5, 2e-3])
    assert learning_rate(SETTINGS, "response", 9, 0.5) == 5e-3  # which is no setting


def test_all_light_has_one_rate() -> None:
    settings = Optimization(light=0.25)
    assert [learning_rate(settings, name, 9, 0.5) for name in ("environment", "lamps")] == [0.125] * 2
