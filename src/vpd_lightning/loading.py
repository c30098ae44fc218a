"""From a checkpoint to a simulator that predicts: ``vpd_lightning.load``."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from vpd_lightning.errors import CheckpointError, ConfigError
from vpd_lightning.release.release_folder import is_release, read_release

_PREFIX = "simulator."
_LARGE = ("state_dict", "optimizer_states", "lr_schedulers")


@dataclass(frozen=True)
class LoadedModel:
    """A trained system in evaluation mode, the plain configuration it was built from, and the file it came from.

    ``simulator`` is a ``Simulator`` where the system is made of encoder, dynamics and renderer, and else another kind
    of ``AbstractSystem``: which one depends on the file. ``sha256`` is that of the file. ``trained_on`` holds the
    SHA-256 of each trajectory that a training of these weights saw (None: the file does not say), ``checkpoint`` what a
    checkpoint says beside its weights and the state of the optimiser (None: a released model).
    """

    simulator: Any
    config: dict[str, Any]
    path: Path
    step: int
    sha256: str
    trained_on: frozenset[str] | None
    checkpoint: Mapping[str, Any] | None

    @property
    def input_views(self) -> list[int]:
        """The cameras that the encoder looks through."""
        return list(self.config["scene"]["input_views"])

    @property
    def name(self) -> str:
        """The experiment that trained it."""
        return str(self.config.get("experiment", "custom"))


def load(path: str | Path, device: str | torch.device = "cpu") -> Any:
    """Load the system of a checkpoint, of a run folder (its newest good checkpoint) or of a released folder.

    It is a ``Simulator``, or, where it is not made of encoder, dynamics and renderer, another kind of
    ``AbstractSystem``.

    Only plain tensors and a plain configuration are read, and the configuration is checked against the list of classes
    that may be built, so a checkpoint from elsewhere cannot run code.

    Raises:
        CheckpointError: the file is missing, damaged, not ours, or does not fit the model it describes.
        ConfigError: there is no such device.
    """
    return load_model(path, device).simulator


def load_model(
    path: str | Path,
    device: str | torch.device = "cpu",
    change: Mapping[str, Any] | None = None,
    *,
    sleeping: bool = False,
) -> LoadedModel:
    """Load a simulator together with its configuration; see ``load``.

    ``change`` replaces settings of its configuration, for example ``{"renderer": {"max_radius": 1.6}}``: what does not
    touch the weights may differ from training. ``sleeping`` leaves what has come to rest out of rollouts (approximate,
    see ``dynamics.sleeping``); it comes before ``change``, which may then set ``dynamics.rest_speed`` and the like.

    Raises:
        ConfigError: ``change`` names a section or a setting that the model does not have, or it has no particles that
            could sleep.
    """
    # Imported here: importing the package must not need Hydra or Lightning.
    from vpd_lightning.config import build_simulator
    from vpd_lightning.config.building import refuse_references
    from vpd_lightning.config.migrations import changed, upgraded
    from vpd_lightning.config.sleeping import with_sleeping

    target = find_device(device)
    stored = read_stored(Path(path).expanduser())
    path = stored.path
    if not isinstance(stored.config, dict) or not isinstance(stored.config.get("scene"), dict):
        raise CheckpointError(f"{path} does not say what model it holds (no hyper_parameters).\nUse one of vpd-train.")
    try:  # before anything reads it: a trained configuration holds values, and nothing to look up
        refuse_references(stored.config, "hyper_parameters")
    except ConfigError as error:
        raise CheckpointError(f"{path} may not be loaded.\n{error}") from error
    try:
        config = upgraded(stored.config)
    except ConfigError as error:
        raise CheckpointError(f"{path} describes a model that this version cannot build.\n{error}") from error
    if sleeping and not config.get("dynamics"):
        raise ConfigError(f"sleeping=true needs particles, and {path} has none.\nRemove it.")
    if sleeping:
        config = with_sleeping(config)
    if change:
        config = changed(config, change)
    try:
        simulator = build_simulator(config)
    except ConfigError as error:
        if change:
            raise
        raise CheckpointError(
            f"{path} describes a model that this version cannot build.\n{str(error).splitlines()[0]}"
        ) from error
    try:
        simulator.load_state_dict(stored.weights)
    except RuntimeError as error:
        detail = " ".join(str(error).split())
        if change:
            raise ConfigError(
                f"change={dict(change)} asks for other weights than {path} holds.\n{detail[:300]}"
            ) from error
        raise CheckpointError(f"The weights in {path} do not fit the model it describes.\n{detail[:300]}") from error
    return LoadedModel(
        simulator.to(target).eval(), config, path, stored.step, stored.sha256, stored.trained_on, stored.checkpoint
    )


@dataclass(frozen=True)
class StoredModel:
    """What a file on disk says: weights by their names in the system, and a configuration that nobody checked yet."""

    path: Path
    weights: Mapping[str, torch.Tensor]
    config: Any
    step: int
    sha256: str
    trained_on: frozenset[str] | None
    checkpoint: Mapping[str, Any] | None


def read_stored(path: Path) -> StoredModel:
    """Read a checkpoint, the newest good one of a run folder, or a released folder (or the weights in one).

    Raises:
        CheckpointError: there is none, or it is damaged.
    """
    from vpd_lightning.data.trained_on import TRAINED_ON
    from vpd_lightning.training.checkpoint_files import open_checkpoint
    from vpd_lightning.training.checkpoints import open_resume

    if is_release(path):
        released = read_release(path)
        return StoredModel(
            released.path, released.weights, released.config, released.step,
            sha256=released.sha256, trained_on=_checksums(released.trained_on), checkpoint=None,
        )  # fmt: skip
    opened = open_resume(path) if path.is_dir() else open_checkpoint(path)
    content = opened.content
    step = content.get("global_step", 0)
    return StoredModel(
        path=opened.path,
        weights=simulator_weights(content),
        config=content.get("hyper_parameters"),
        step=step if isinstance(step, int) else 0,
        sha256=opened.sha256,
        trained_on=_checksums(content.get(TRAINED_ON)),
        checkpoint={name: value for name, value in content.items() if name not in _LARGE},
    )


def _checksums(stored: Any) -> frozenset[str] | None:
    return frozenset(map(str, stored)) if isinstance(stored, list) else None


def simulator_weights(content: Mapping[str, Any]) -> dict[str, torch.Tensor]:
    """Return the system's own weights of a checkpoint's content, under the names they have in the system."""
    state = content["state_dict"]
    return {name.removeprefix(_PREFIX): value for name, value in state.items() if name.startswith(_PREFIX)}


def find_device(device: str | torch.device) -> torch.device:
    """Return a device that is there; ``auto`` is the GPU where there is one.

    Raises:
        ConfigError: the name means nothing, or the machine lacks it.
    """
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        found = torch.device(device)
        torch.empty(0, device=found)
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        reason = str(error).splitlines()[0]
        raise ConfigError(f"There is no device {str(device)!r}: {reason}\nUse device=cpu, or device=auto.") from error
    return found
