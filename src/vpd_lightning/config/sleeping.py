"""A trained model's configuration with sleeping particles, though it was trained without them."""

from collections.abc import Mapping
from typing import Any

from omegaconf import OmegaConf

from vpd_lightning.config.composing import plain
from vpd_lightning.config.paths import config_folder

_TARGET = "vpd_lightning.dynamics.sleeping.SleepingDynamics"


def with_sleeping(config: Mapping[str, Any], settings: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return a model's plain configuration with its dynamics wrapped in ``SleepingDynamics``; the weights stay its own.

    Settings are those of ``conf/dynamics/sleeping.yaml``, in the scene of the model; ``settings`` replaces some. Where
    the dynamics sleeps already, only these are replaced.
    """
    section = config["dynamics"]
    if section["_target_"] != _TARGET:
        option = OmegaConf.load(config_folder() / "dynamics" / "sleeping.yaml")
        whole = plain(OmegaConf.create({"scene": dict(config["scene"]), "dynamics": option}))
        del whole["dynamics"]["defaults"]  # says which dynamics to wrap where there is none yet
        section = {**whole["dynamics"], "dynamics": section}
    return {**config, "dynamics": {**section, **(settings or {})}}
