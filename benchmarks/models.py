"""Trained models for the suites that need them, with a recording to compare with."""

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from benchmarks.measuring import Options
from vpd_lightning.errors import ConfigError, DataError
from vpd_lightning.simulator import Simulator


@dataclass(frozen=True)
class Model:
    """A checkpoint: its simulator, the configuration to build variants from, and the folder of its data."""

    simulator: Simulator
    config: Mapping[str, Any]
    data: Path
    step: int

    @property
    def input_views(self) -> list[int]:
        """The cameras that the encoder looks through."""
        return list(self.config["scene"]["input_views"])

    def kind(self, stage: str) -> str:
        """Return the module's name of a stage, for example ``surface``."""
        return str(self.config[stage]["_target_"]).split(".")[-2]

    def knows(self, stage: str, key: str) -> bool:
        """Whether the stage has a setting of this name."""
        return key in self.config[stage]

    def variant(self, stage: str, **changes: Any) -> Simulator:
        """Build the same weights with other settings of one stage.

        Raises:
            ConfigError: the stage has no such setting.
        """
        from vpd_lightning.config import build_simulator

        config = deepcopy(dict(self.config))
        config[stage] = {**config[stage], **changes}
        simulator = build_simulator(config)
        simulator.load_state_dict(self.simulator.state_dict())
        return simulator.to(next(self.simulator.parameters()).device).eval()

    def clip(self, num_steps: int, trajectory: int = 0) -> Any:
        """Read the first clip of a trajectory of the test split."""
        from vpd_lightning.data.clip import read_clip
        from vpd_lightning.data.manifest import load_manifest

        paths = load_manifest(self.data).split("test")
        start = (self.config.get("protocol") or {}).get("start_frames") or [0]
        return read_clip(paths[min(trajectory, len(paths) - 1)], trajectory, start[0], num_steps, with_state=False)


def load_models(options: Options) -> dict[str, Model]:
    """Load the checkpoints of the options under short names: experiment and renderer, numbered where they repeat.

    Raises:
        ConfigError: a path that leads nowhere.
        CheckpointError: a file that is no checkpoint of ours.
    """
    from vpd_lightning.loading import load_model

    models: dict[str, Model] = {}
    for path in options.checkpoints:
        if not path.exists():
            raise ConfigError(f"there is no checkpoint {path}.\nIt was given by ckpt=[...].")
        loaded = load_model(path, options.device)
        data = options.data or Path(loaded.config["data"]["folder"])
        if not data.is_dir():
            raise DataError(f"{data}, the data of {path}, is not there.\nGive data.folder=FOLDER.")
        model = Model(loaded.simulator, loaded.config, data, loaded.step)
        name = f"{model.kind('dynamics')} + {model.kind('renderer')}"
        while name in models:
            name += " (another)"
        models[name] = model
    torch.manual_seed(0)
    return models
