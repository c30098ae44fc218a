"""Configurations of older checkpoints: settings that came later, and settings and classes that are gone."""

from collections.abc import Mapping
from difflib import get_close_matches
from typing import Any

from vpd_lightning.errors import ConfigError
from vpd_lightning.moved import current_name

_RENDERER = "vpd_lightning.renderer."
_DYNAMICS = "vpd_lightning.dynamics."
_OLD_VERSION = "Use the version of vpd-lightning that trained it."
ANY_VALUE = object()
_PLAIN_FEATURES = {"kernel_normalization": None, "normalization_epsilon": 1e-6, "feature_network": None}

ADDED_SETTINGS: dict[str, dict[str, Any]] = {
    # All of these say how fast something is computed, or leave something out that the model was not trained with.
    f"{_RENDERER}point_nerf.PointNeRFRenderer": {
        "features_backend": "auto",
        "sort_particles": True,
        "reuse_coarse": True,
        "max_radius": None,
        **_PLAIN_FEATURES,
    },
    f"{_DYNAMICS}hierarchical_gnn.HierarchicalGNNDynamics": {
        "edge_capacity": None,
        "compile": False,
        "max_abstract_edges_per_node": None,
        "feature_limit": 1e4,
        "zero_init_decoders": False,
        "normalized_edges": False,
        "edge_gain": 1.0,
        "aggregation": "sum",
        "update_features": True,
        "has_driven": False,
    },
    f"{_DYNAMICS}inertial.InertialDynamics": {
        "keep_shape": True,
        "carry_memory": True,
        "extent_weight": 0.0,
        "acceleration_gain": 1.0,
        "num_contact_substeps": None,
        "guess_hidden": False,
        "has_driven": False,
        "max_friction": None,
        "infers_guided": False,
        "edge_reach": None,
        "workspace_min": None,
        "workspace_max": None,
        "supported_speed": 0.0,
        "round_contact": False,
        "is_damped": True,
        "skip_resting": False,
        "force_reach": None,
    },
    f"{_RENDERER}surface.SurfaceRenderer": {"candidate_backend": "auto", **_PLAIN_FEATURES},
    "vpd_lightning.simulator.Simulator": {"pixel_gradient_to_motion": 1.0},
    # kernel_scales and layer_depth were in metres.
    f"{_RENDERER}splat.SplatRenderer": {
        "candidate_backend": "auto",
        "surface_scale": 1.0,
        "color_features": False,
        "background_frequencies": 0,
        "facing_softness": None,
        "has_scenery": False,
        "num_scenery_candidates": 12,
        "elliptic_footprints": False,
        "far_pixels": False,
        "seen_through": False,
        "unseen_ground": False,
        "num_lights": 0,
        "num_occluders": 512,
        "shadow_softness": 0.5,
    },
    "vpd_lightning.data.datamodule.VideoDataModule": {
        "sensor": "none",
        "sensor_percent": None,
        "load_driven": False,
    },
    "vpd_lightning.encoder.particles.wide_surface_background.WideSurfaceBackground": {"noise_floor": 0.001},
    f"{_DYNAMICS}inertial.first_velocity.FirstVelocity": {"picture_weight": 0.0},
    "vpd_lightning.encoder.unet.UNetEncoder": {
        "color_features": False,
        "same_pixels": False,
        "has_scenery": False,
        "has_driven": False,
    },
    "vpd_lightning.encoder.unet_depth.DepthPredictingEncoder": {"has_driven": False},
}
"""By class: arguments added since the first checkpoints, with values that leave those models as they were."""


REMOVED_SETTINGS: dict[str, dict[str, Any]] = {
    f"{_DYNAMICS}inertial.InertialDynamics": {"damps_spin": True},
    f"{_RENDERER}point_nerf.PointNeRFRenderer": {
        "early_stop": 0.0,
        "num_stop_segments": ANY_VALUE,  # without effect where early_stop was off
        "share_rows_below": None,
    },
}
"""By class: arguments of older checkpoints that are gone, with the value that meant "off"; on, they are refused."""

REMOVED_CLASSES = (f"{_DYNAMICS}velocity_gnn.VelocityGNNDynamics",)
"""Classes that older checkpoints may name. docs/benchmarks.md ("What was measured and left out") says why they went."""


def upgraded(config: Mapping[Any, Any], where: str = "") -> dict[Any, Any]:
    """Return a stored configuration as this version writes it; values given stay.

    Settings that its classes have got since are added, and those that they have lost are left out where they were off.

    Raises:
        ConfigError: it names a class that is gone, or a setting that is gone and was on.
    """
    result = {}
    for name, section in config.items():
        if isinstance(section, Mapping):
            section = upgraded(section, f"{where}{name}.")
            if isinstance(section.get("_target_"), str):
                section["_target_"] = current_name(section["_target_"])
            target = str(section.get("_target_"))
            if target in REMOVED_CLASSES:
                raise ConfigError(f"{where}{name} is a {target}, which this version no longer has.\n{_OLD_VERSION}")
            section = {**ADDED_SETTINGS.get(target, {}), **_without_removed(section, target, f"{where}{name}")}
        result[name] = section
    return result


def _without_removed(section: Mapping[Any, Any], target: str, where: str) -> dict[Any, Any]:
    removed = REMOVED_SETTINGS.get(target, {})
    for name, off in removed.items():
        if name in section and off is not ANY_VALUE and section[name] != off:
            raise ConfigError(
                f"{where}.{name}={section[name]} is a setting that this version no longer has (off was {off}).\n"
                + _OLD_VERSION
            )
    return {name: value for name, value in section.items() if name not in removed}


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
