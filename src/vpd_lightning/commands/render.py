"""``vpd-render``: film what a trained simulator predicts, from any camera, and keep its particles."""

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

    config = configure("render", words)
    if config is not None:
        _render(config)
    return 0


def _render(config: Mapping[str, Any]) -> None:
    import torch

    from vpd_lightning.commands.eval import data_folder, set_threads
    from vpd_lightning.commands.progress import show_progress
    from vpd_lightning.data.manifest import file_sha256, load_manifest
    from vpd_lightning.errors import OutOfMemoryError
    from vpd_lightning.evaluation import filming
    from vpd_lightning.export.output_folder import OutputFolder, beside_checkpoint, choose_folder
    from vpd_lightning.loading import load_model
    from vpd_lightning.simulator import Simulator

    _check(config)
    set_threads(config["num_threads"])
    model = load_model(config["ckpt"], config["device"], config["change"], sleeping=config["sleeping"])
    if not isinstance(model.simulator, Simulator):
        raise ConfigError(
            f"{model.path} predicts the videos of its own cameras and knows no others: there is nothing to film.\n"
            "vpd-eval shows its predictions beside the truth."
        )
    manifest = load_manifest(data_folder(config["data"]["folder"], model.config))
    path = _choose_trajectory(manifest.split(config["split"]), config)
    start, num_steps = config["start_frame"], config["num_steps"]
    clip = filming.read_context(path, start)
    chosen = filming.choose_viewpoints(config["camera"], path, start, num_steps + 1, model.input_views)
    viewpoints = filming.resize_viewpoints(chosen, config["height"], config["width"])
    folder = choose_folder(config["out"], beside_checkpoint(model.path, "render"))
    with OutputFolder(folder) as partial:
        try:
            with show_progress() as progress:
                states, frames = filming.film(model.simulator, clip, num_steps, model.input_views, viewpoints, progress)
        except torch.OutOfMemoryError as error:
            raise OutOfMemoryError(
                "The device ran out of memory while rendering.\nLower height and width, or use device=cpu."
            ) from error
        truth = None
        if viewpoints.views is not None:
            truth = filming.recorded_frames(path, start, num_steps, viewpoints.views)
        filming.write_films(partial, viewpoints, frames.numpy(), truth, config["fps"])
        filming.write_particle_folder(partial, model.simulator, clip, states, config["save_particles"])
        filming.write_description(
            partial / "render.json",
            {
                "checkpoint": str(model.path),
                "checkpoint_sha256": file_sha256(model.path),
                "data": str(manifest.folder),
                "trajectory": manifest.relative(path),
                "start_frame": start,
                "num_steps": num_steps,
                "camera": config["camera"],
                "height": viewpoints.cameras.height,
                "width": viewpoints.cameras.width,
                "films": [f"{name}.webm" for name in viewpoints.names],
            },
        )
    count = len(viewpoints.names)
    films = "1 film" if count == 1 else f"{count} films"
    print(f"{films} of {num_steps} steps from {manifest.relative(path)}, start frame {start}")
    print(folder)


def _check(config: Mapping[str, Any]) -> None:
    from vpd_lightning.evaluation.filming import PARTICLE_FORMATS

    for name, lowest in (("num_steps", 1), ("start_frame", 0), ("trajectory", 0)):
        if config[name] < lowest:
            raise ConfigError(f"{name}={config[name]} is out of range.\nAllowed: {lowest} or more.")
    for name in ("height", "width"):
        if config[name] is not None and config[name] < 1:
            raise ConfigError(f"{name}={config[name]} is out of range.\nAllowed: 1 pixel or more, or null.")
    if not 0 < config["fps"] <= 1000:
        raise ConfigError(f"fps={config['fps']} is out of range.\nAllowed: above 0, up to 1000.")
    unknown = [name for name in config["save_particles"] if name not in PARTICLE_FORMATS]
    if unknown:
        raise ConfigError(
            f"save_particles has {unknown[0]!r}.\nAllowed: {', '.join(PARTICLE_FORMATS)}, or [] for none."
        )


def _choose_trajectory(paths: Sequence[Path], config: Mapping[str, Any]) -> Path:
    if config["trajectory"] >= len(paths):
        raise ConfigError(
            f"There is no trajectory {config['trajectory']} in split {config['split']}.\n"
            f"It has {len(paths)} (0 to {len(paths) - 1})."
        )
    return paths[config["trajectory"]]


if __name__ == "__main__":
    sys.exit(main())
