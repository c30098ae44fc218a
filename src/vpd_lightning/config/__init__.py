"""Configuration: composing it, checking it, and the one place that turns it into objects."""

from vpd_lightning.config.building import build, build_list, build_simulator, check_targets, check_widths
from vpd_lightning.config.composing import compose, compose_with_folder, expand_sweep, plain, sweep_parameters
from vpd_lightning.config.paths import config_folder
from vpd_lightning.config.plugins import load_plugins
from vpd_lightning.config.pretraining import pretraining_config

__all__ = [
    "build",
    "build_list",
    "build_simulator",
    "check_targets",
    "check_widths",
    "compose",
    "compose_with_folder",
    "config_folder",
    "expand_sweep",
    "load_plugins",
    "plain",
    "pretraining_config",
    "sweep_parameters",
]
