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
        _evaluate(config)
    return 0


def _evaluate(config: Mapping[str, Any]) -> None:
    import torch

    from vpd_lightning.commands.progress import show_progress
    from vpd_lightning.data.manifest import file_sha256, load_manifest
    from vpd_lightning.errors import OutOfMemoryError
    from vpd_lightning.evaluation.evaluate import evaluate
    from vpd_lightning.evaluation.gallery import write_gallery
    from vpd_lightning.evaluation.report import metrics_of, write_metrics
    from vpd_lightning.evaluation.summary import summary_lines
    from vpd_lightning.export.output_folder import OutputFolder, beside_checkpoint, choose_folder
    from vpd_lightning.loading import load_model

    if config["num_videos"] < 0:
        raise ConfigError(f"num_videos={config['num_videos']} is out of range.\nAllowed: 0 or more.")
    set_threads(config["num_threads"])
    model = load_model(config["ckpt"], config["device"], config["change"], sleeping=config["sleeping"])
    protocol = choose_protocol(config["protocol"], model.config.get("protocol"))
    manifest = load_manifest(data_folder(config["data"]["folder"], model.config))
    name = "evaluation" if protocol.split == "test" else f"evaluation_{protocol.split}"
    folder = choose_folder(config["out"], beside_checkpoint(model.path, name))
    with OutputFolder(folder) as partial:
        try:
            with show_progress() as progress:
                evaluation = evaluate(
                    model.simulator, manifest, protocol, model.input_views, max(config["num_videos"], 2), progress
                )
        except torch.OutOfMemoryError as error:
            raise OutOfMemoryError(
                "The device ran out of memory while rendering.\nUse device=cpu, or a device with more memory."
            ) from error
        identity = {
            "model": model.name,
            "checkpoint": str(model.path),
            "checkpoint_sha256": file_sha256(model.path),
            "step": model.step,
            "data": str(manifest.folder),
            "data_sha256": manifest.digest,
            "device": str(next(model.simulator.parameters()).device),
        }
        metrics = metrics_of(evaluation, protocol, identity)
        write_gallery(partial, metrics, evaluation, config["num_videos"])
        write_metrics(partial, metrics, evaluation)
    print(f"{model.name}, step {model.step}: {model.path}")
    print("\n".join(summary_lines(metrics)))
    print()
    print(folder / "metrics.json")


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
