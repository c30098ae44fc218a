"""``vpd-export``: a trained model as a folder that can be given away."""

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from vpd_lightning.commands.report_errors import run_command
from vpd_lightning.errors import ConfigError

_MAX_RAYS = 65536


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
    from vpd_lightning.files import OutputFolder, choose_folder
    from vpd_lightning.loading import load_model
    from vpd_lightning.release.release import TrainedSystem, copy_release, find_metrics, write_release
    from vpd_lightning.release.release_folder import folder_bytes, is_release

    source, folder = Path(config["ckpt"]).expanduser(), choose_folder(config["out"], Path())
    num_rays = config["renderer_program"]
    _check(config, source)
    model = load_model(source)
    trained = TrainedSystem(
        system=model.simulator, config=model.config, checkpoint=model.path, step=model.step,
        sha256=model.sha256, trained_on=model.trained_on,
    )  # fmt: skip
    metrics = None if is_release(source) else find_metrics(trained, config["metrics"])
    with OutputFolder(folder) as partial:
        if num_rays is not None:  # first: it counts among the megabytes
            _write_renderer(partial, model.simulator, num_rays)
        if metrics is None:
            copy_release(model.path.parent, partial, max_megabytes=config["max_megabytes"])
        else:
            write_release(partial, trained, metrics, name=folder.name, max_megabytes=config["max_megabytes"])
    print(f"{model.name}, step {model.step}: {model.path}")
    print(f"{folder_bytes(folder) / 1e6:.1f} MB")
    print(folder)


def _check(config: Mapping[str, Any], source: Path) -> None:
    from vpd_lightning.release.release_folder import is_release

    num_rays = config["renderer_program"]
    if is_release(source) and num_rays is None:
        raise ConfigError(
            f"{source} is a released model already.\n"
            "Give a run folder or a checkpoint; or renderer_program=RAYS for a copy with its renderer as a program."
        )
    if is_release(source) and config["metrics"] is not None:
        raise ConfigError(f"{source} has its figures already.\nLeave metrics out.")
    if num_rays is not None and not 1 <= num_rays <= _MAX_RAYS:
        raise ConfigError(f"renderer_program={num_rays} is out of range.\nAllowed: 1 to {_MAX_RAYS} rays, or null.")


def _write_renderer(folder: Path, system: Any, num_rays: int) -> None:
    from vpd_lightning.release.release_folder import PROGRAM_FILE
    from vpd_lightning.release.renderer_program import export_renderer, write_program
    from vpd_lightning.simulator import Simulator

    num_particles = getattr(getattr(system, "encoder", None), "num_particles", None)
    if not isinstance(system, Simulator) or num_particles is None:
        raise ConfigError("This system has no renderer of particles to export.\nLeave renderer_program out.")
    feature_dim = system.encoder.feature_dim
    program = export_renderer(system.renderer, num_particles=num_particles, feature_dim=feature_dim, num_rays=num_rays)
    write_program(folder / PROGRAM_FILE, program)


if __name__ == "__main__":
    sys.exit(main())
