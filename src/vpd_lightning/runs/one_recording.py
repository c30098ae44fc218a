"""What commands that look at one recording share: a simulator of particles, its data set, one trajectory of it."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vpd_lightning.data.manifest import Manifest, load_manifest
from vpd_lightning.errors import ConfigError
from vpd_lightning.loading import LoadedModel, load_model
from vpd_lightning.runs.provide_data import provide_data
from vpd_lightning.simulator import Simulator


def load_particle_simulator(config: Mapping[str, Any]) -> LoadedModel:
    """Load the model of a command's configuration.

    Raises:
        ConfigError: it has no particles to look at.
        CheckpointError: see ``load_model``.
    """
    model = load_model(config["ckpt"], config["device"], config["change"], sleeping=config["sleeping"])
    if not isinstance(model.simulator, Simulator):
        raise ConfigError(
            f"{model.path} predicts video for its own cameras only; it cannot render other views.\n"
            "vpd-eval shows its predictions beside the truth."
        )
    return model


def data_set(folder: str | None, config: Mapping[str, Any], only: tuple[str, int] | None = None) -> Manifest:
    """Return the data set asked for, or that of the training, which is made anew where the training would make it.

    Where one trajectory (split, number) is all that is needed, ``only`` it is made.
    """
    if folder is None and (config.get("generate") or {}).get("when_missing"):
        return load_manifest(provide_data(config, only=only))
    return load_manifest(data_folder(folder, config))


def data_folder(wanted: str | None, config: Mapping[str, Any]) -> Path:
    """Return the data set to use: the one asked for, or the one that the model was trained on."""
    folder = wanted or config.get("data", {}).get("folder")
    if not isinstance(folder, str):
        raise ConfigError("The checkpoint does not say what data it was trained on.\nGive data.folder=FOLDER.")
    return Path(folder)


def choose_trajectory(manifest: Manifest, split: str, number: int) -> Path:
    """Return the file of a trajectory.

    Raises:
        ConfigError: the split has none of that number.
    """
    paths = manifest.split(split)
    if not 0 <= number < len(paths):
        raise ConfigError(
            f"There is no trajectory {number} in split {split}.\nIt has {len(paths)} (0 to {len(paths) - 1})."
        )
    return paths[number]
