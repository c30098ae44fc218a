"""Configurations of older checkpoints: what a setting that came later means for a model that never heard of it."""

from collections.abc import Mapping
from difflib import get_close_matches
from typing import Any

from vpd_lightning.errors import ConfigError
from vpd_lightning.moved import current_name

_RENDERER = "vpd_lightning.renderer."
_DYNAMICS = "vpd_lightning.dynamics."
_PLAIN_FEATURES = {"kernel_normalization": None, "normalization_epsilon": 1e-6, "feature_network": None}

ADDED_SETTINGS: dict[str, dict[str, Any]] = {
    # All of these say how fast something is computed, or leave something out that the model was not trained with.
    f"{_RENDERER}point_nerf.PointNeRFRenderer": {
        "features_backend": "auto",
        "sort_particles": True,
        "reuse_coarse": True,
        "max_radius": None,
        "early_stop": 0.0,
        "num_stop_segments": 4,
        "share_rows_below": None,
        **_PLAIN_FEATURES,
    },
    f"{_DYNAMICS}hierarchical_gnn.HierarchicalGNNDynamics": {
        "edge_capacity": None,
        "compile": False,
        "max_abstract_edges_per_node": None,
        "feature_limit": 1e4,
    },
    f"{_DYNAMICS}inertial.InertialDynamics": {"keep_shape": True, "carry_memory": True},
    f"{_RENDERER}surface.SurfaceRenderer": {"candidate_backend": "auto", **_PLAIN_FEATURES},
    "vpd_lightning.simulator.Simulator": {"pixel_gradient_to_motion": 1.0},
    # kernel_scales and layer_depth were in metres.
    f"{_RENDERER}splat.SplatRenderer": {
        "candidate_backend": "auto",
        "surface_scale": 1.0,
        "color_features": False,
        "background_frequencies": 0,
    },
    "vpd_lightning.encoder.unet.UNetEncoder": {"color_features": False},
}
"""By class: arguments added since the first checkpoints, with values that leave those models as they were."""


def upgraded(config: Mapping[Any, Any]) -> dict[Any, Any]:
    """Return a stored configuration with today's names of its classes and the settings they got since; values stay."""
    result = {}
    for name, section in config.items():
        if isinstance(section, Mapping):
            section = upgraded(section)
            if isinstance(section.get("_target_"), str):
                section["_target_"] = current_name(section["_target_"])
            section = {**ADDED_SETTINGS.get(str(section.get("_target_")), {}), **section}
        result[name] = section
    return result


def changed(config: Mapping[str, Any], change: Any, where: str = "change") -> dict[str, Any]:
    """Return a configuration with some of its values replaced; sections are merged, everything else is replaced whole.

    Raises:
        ConfigError: ``change`` names a key that is not there, or a value where a section is.
    """
    if not isinstance(change, Mapping):
        raise ConfigError(f"{where}={change} is no section.\nGive it as {where}={{SECTION: {{SETTING: VALUE}}}}.")
    result = dict(config)
    for key, value in change.items():
        if key not in config:
            near = get_close_matches(str(key), [str(name) for name in config], n=1)
            hint = f"Did you mean {where}.{near[0]}?" if near else f"There are: {', '.join(map(str, config))}."
            raise ConfigError(f"there is no {where}.{key}: the model's configuration has no such key.\n{hint}")
        if isinstance(config[key], Mapping):
            value = changed(config[key], value, f"{where}.{key}")
        result[key] = value
    return result
