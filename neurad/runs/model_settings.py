"""The settings under ``model`` of a shipped config, for what trains without the command line."""

from __future__ import annotations

from typing import Any

from omegaconf import OmegaConf

from neurad.assembly.settings import Lighting, ModelSettings, Objective, Optimization, Sampling
from neurad.core.errors import InputError
from neurad.fields.settings import FieldConfig, GridConfig, RadianceConfig, RoughnessConfig
from neurad.integrators.radiometric import Radiometric
from neurad.runs.configs import load_config


def model_settings(config: str, seed: int = 0) -> ModelSettings:
    """Fields, numbers of samples, objective, learning rates and lighting of a config for the paper's method.

    Args:
        config: path or shipped name, as behind ``--config``.
        seed: of the run.

    Raises:
        InputError: the file is missing, or its method is another one.
    """
    model: Any = OmegaConf.to_container(OmegaConf.merge(*load_config(config)).model)
    method = model.get("method") or {"class_path": f"{Radiometric.__module__}.{Radiometric.__name__}"}
    if not method["class_path"].endswith(f".{Radiometric.__name__}"):
        raise InputError(f"config {config}: its method is {method['class_path']}, not the paper's")
    return ModelSettings(
        albedo=FieldConfig(**_sizes(model["albedo"])),
        roughness=RoughnessConfig(**_sizes(model["roughness"])),
        radiance=RadianceConfig(**_sizes(model["radiance"])),
        sampling=Sampling(**model.get("sampling", {})),
        objective=Objective(**model.get("objective", {})),
        optimization=Optimization(**model.get("optimization", {})),
        lighting=Lighting(**model.get("lighting", {})),
        method=Radiometric(**method.get("init_args", {})),
        seed=seed,
    )


def batch_pixels(config: str) -> int:
    """Pixels of a batch of a config, apart from its ``pixel_multiplier``."""
    data: Any = OmegaConf.to_container(OmegaConf.merge(*load_config(config)).data)
    return int(data["patches"] * data.get("patch_size", 1) ** 2)


def _sizes(settings: dict[str, Any]) -> dict[str, Any]:
    """Arguments of a field's settings."""
    if settings.get("inputs") is not None:
        settings = {**settings, "inputs": tuple(settings["inputs"])}
    return {**settings, "grid": GridConfig(**settings["grid"])} if "grid" in settings else dict(settings)
