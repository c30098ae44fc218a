"""``vpd-eval``: how good is a trained simulator on held-out video?"""

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from vpd_lightning.commands.report_errors import run_command
from vpd_lightning.errors import ConfigError


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of the console command; returns the exit code."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    return run_command(lambda: _run(words))


def _run(words: list[str]) -> int:
    from vpd_lightning.commands.hydra_application import configure

    config = configure("eval", words)
    if config is not None:
        from vpd_lightning.runs.evaluation_run import run_evaluation

        run_evaluation(config)
    return 0


def choose_protocol(wanted: Mapping[str, Any], of_run: Mapping[str, Any] | None) -> Any:
    """Return the protocol: what the run's configuration says, with the values that are set replacing its own.

    Raises:
        ConfigError: the run has no protocol (an old checkpoint) and none was chosen, or a value is out of range.
    """
    from vpd_lightning.evaluation.protocol import Protocol

    whole = all(value is not None for key, value in wanted.items() if key != "num_trajectories")
    values = dict(wanted) if whole else {**(of_run or {}), **{k: v for k, v in wanted.items() if v is not None}}
    missing = [key for key in wanted if key not in values]
    if missing:
        raise ConfigError(f"The run does not say how to evaluate it ({missing[0]} is missing).\nSet protocol=paper.")
    return Protocol(**{key: values[key] for key in wanted})


def data_folder(wanted: str | None, config: Mapping[str, Any]) -> Path:
    """Return the data set to use: the one asked for, or the one that the model was trained on."""
    folder = wanted or config.get("data", {}).get("folder")
    if not isinstance(folder, str):
        raise ConfigError("The checkpoint does not say what data it was trained on.\nGive data.folder=FOLDER.")
    return Path(folder)


def set_threads(count: int | None) -> None:
    """Give PyTorch this many CPU threads; None leaves it alone."""
    import torch

    if count is None:
        return
    if count < 1:
        raise ConfigError(f"num_threads={count} is out of range.\nAllowed: 1 or more, or null.")
    torch.set_num_threads(count)


if __name__ == "__main__":
    sys.exit(main())
