"""A fit with the settings of a shipped config, read as ``neurad fit`` reads them."""

from __future__ import annotations

from typing import Any

from neurad.assembly.settings import Objective, Sampling
from neurad.fields.settings import FieldConfig, GridConfig, RadianceConfig, RoughnessConfig
from neurad.studies.stress.fit import Fields, Plan


def plan_of(config: str) -> Plan:
    """Field sizes, batch, samples and objective of a config; its schedule and learning rates are a fit's own.

    Args:
        config: path or shipped name, as behind ``--config``.
    """
    from omegaconf import OmegaConf

    from neurad.runs.configs import load_config

    merged = OmegaConf.merge(*load_config(config))
    model: Any = OmegaConf.to_container(merged.model)
    data: Any = OmegaConf.to_container(merged.data)
    fields = Fields(
        FieldConfig(**_sizes(model["albedo"])),
        RoughnessConfig(**_sizes(model["roughness"])),
        RadianceConfig(**_sizes(model["radiance"])),
    )
    return Plan(
        pixels=data["patches"] * data["patch_size"] ** 2,
        sampling=Sampling(**model["sampling"]),
        objective=Objective(**model["objective"]),
        fields=fields,
    )


def _sizes(settings: dict[str, Any]) -> dict[str, Any]:
    if settings.get("inputs") is not None:
        settings = {**settings, "inputs": tuple(settings["inputs"])}
    return {**settings, "grid": GridConfig(**settings["grid"])}
