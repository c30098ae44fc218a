"""``vpd-export``: a trained model as a folder that can be given away."""

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

    config = configure("export", words)
    if config is not None:
        _export(config)
    return 0


def _export(config: Mapping[str, Any]) -> None:
    from vpd_lightning.export.output_folder import OutputFolder, choose_folder
    from vpd_lightning.export.release import TrainedSystem, find_metrics, write_release
    from vpd_lightning.export.release_folder import folder_bytes, is_release
    from vpd_lightning.loading import load_model

    source, folder = Path(config["ckpt"]).expanduser(), choose_folder(config["out"], Path())
    if is_release(source):
        raise ConfigError(f"{source} is a released model already.\nGive a run folder or a checkpoint.")
    model = load_model(source)
    trained = TrainedSystem(system=model.simulator, config=model.config, checkpoint=model.path, step=model.step)
    metrics = find_metrics(trained, config["metrics"])
    with OutputFolder(folder) as partial:
        write_release(partial, trained, metrics, name=folder.name, max_megabytes=config["max_megabytes"])
    print(f"{model.name}, step {model.step}: {model.path}")
    print(f"{folder_bytes(folder) / 1e6:.1f} MB")
    print(folder)


if __name__ == "__main__":
    sys.exit(main())
