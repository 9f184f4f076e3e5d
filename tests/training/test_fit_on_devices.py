"""One whole fit on every device: through the command line, evaluated, continued and scored again on the CPU."""

from contextlib import contextmanager

import pytest
import torch
from helpers.devices import CUDA, on_cuda, on_devices
from helpers.tiny_fit import checkpoint, few_views, fit, metrics, run_folder, write_tiny_config
from lightning.pytorch.strategies import SingleDeviceStrategy

from neurad.cli import main


@pytest.fixture(autouse=True)
def _few_views(monkeypatch):
    few_views(monkeypatch, "patterns")


def words(device, tracer):
    return [f"--trainer.accelerator={'gpu' if device == 'cuda' else 'cpu'}", f"--model.tracer={tracer}"]


@pytest.mark.parametrize(
    ("device", "scene"),
    [("cpu", "cornell"), *(pytest.param("cuda", name, marks=CUDA.marks) for name in ("cornell", "patterns"))],
)
def test_a_fit_with_rays_on_the_device(tiny, device, scene):
    """``cornell`` is diffuse; ``patterns`` has roughness, a guide and a control variate."""
    pytest.importorskip("warp")
    fit(f"--data.scene={scene}", "--trainer.max_steps=4", "--data.patches=8", *words(device, "warp"))
    state = checkpoint()
    assert state["neurad"]["iteration"] == 4
    assert len(state["optimizer_states"]) == (2 if scene == "cornell" else 3)
    assert all(bool(value.isfinite().all()) for value in state["state_dict"].values() if value.is_floating_point())
    assert float(metrics()[-1]["albedo_psnr"]) > 5
    # What a device has trained, the CPU continues and scores.
    main(["fit", "--ckpt_path=last", "--trainer.max_steps=6", *words("cpu", "embree")])
    assert checkpoint()["neurad"]["iteration"] == 6
    main(["test", *words("cpu", "embree"), "--trainer.enable_progress_bar=false"])
    assert (run_folder() / "images" / "000_albedo.exr").is_file()


@on_cuda
@pytest.mark.parametrize("method", ["prb", "direct", "debiased"])
def test_methods_train_on_the_device(tiny, device, method):
    fit("--config", f"methods/{method}.yaml", "--trainer.max_steps=3", *words(device, "embree"))
    state = checkpoint()
    assert state["neurad"]["iteration"] == 3
    biases = [v for k, v in state["state_dict"].items() if k.startswith("materials.") and k.endswith("bias")]
    assert any(float(v.abs().max()) > 0 for v in biases)  # they start at zero


@on_devices
def test_the_paper_s_settings_train_on_the_device(tiny, device):
    write_tiny_config(base="paper.yaml", data={"root": None, "scene": "patterns", "patch_size": 4})
    fit("--trainer.max_steps=3", *words(device, "embree"))
    assert checkpoint()["neurad"]["iteration"] == 3
    assert len(checkpoint()["optimizer_states"]) == 3


@on_cuda
def test_a_fit_goes_on_on_its_device(tiny, device):
    """What its optimizers remember is read on the CPU."""
    write_tiny_config(base="scene.yaml", data={"root": None, "scene": "patterns", "patch_size": 4})
    fit("--trainer.max_steps=3", *words(device, "embree"))
    main(["fit", "--ckpt_path=last", "--trainer.max_steps=6", *words(device, "embree")])
    state = checkpoint()
    assert state["neurad"]["iteration"] == 6
    assert all(bool(value.isfinite().all()) for value in state["state_dict"].values() if value.is_floating_point())


def test_parts_are_made_on_the_cpu_wherever_a_trainer_makes_tensors(tiny, monkeypatch):
    """A trainer on a GPU makes that the default device while a module builds its parts. The ``meta`` device stands for
    it here, from which nothing could be read.
    """

    @contextmanager
    def elsewhere(self, empty_init=None):
        with torch.device("meta"):
            yield

    monkeypatch.setattr(SingleDeviceStrategy, "tensor_init_context", elsewhere)
    fit("--data.scene=patterns", "--trainer.max_steps=2", "--model.lighting.emitters=fit")
    state = checkpoint()
    assert state["neurad"]["iteration"] == 2
    assert all(not value.is_meta for value in state["state_dict"].values())
