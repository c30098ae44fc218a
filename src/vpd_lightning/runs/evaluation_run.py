"""One evaluation, from its checked configuration to its files: for ``vpd-eval``, and for what follows a training."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
import yaml

from vpd_lightning.data.manifest import Manifest
from vpd_lightning.data.trained_on import DATA_SHA256
from vpd_lightning.errors import ConfigError, OutOfMemoryError
from vpd_lightning.evaluation.protocol import Protocol
from vpd_lightning.evaluation.seen import seen_in_training
from vpd_lightning.files import OutputFolder, choose_folder
from vpd_lightning.loading import LoadedModel, load_model
from vpd_lightning.release.results_folder import beside_checkpoint
from vpd_lightning.runs.one_recording import data_set
from vpd_lightning.runs.progress import show_progress
from vpd_lightning.runs.threads import set_threads

if TYPE_CHECKING:
    from vpd_lightning.evaluation.evaluate import Evaluation

# Modules that measure and draw are imported where they are used, so that the first line is printed at once.

_DEFAULT_SYSTEM = "vpd"  # checkpoints from before there were others do not say


def run_evaluation(config: Mapping[str, Any]) -> Path:
    """Evaluate as the configuration of ``vpd-eval`` says, print the summary, and return the path of ``metrics.json``.

    Raises:
        VPDError: whatever is wrong with configuration, checkpoint, data or memory.
    """
    if config["num_videos"] < 0:
        raise ConfigError(f"num_videos={config['num_videos']} is out of range.\nAllowed: 0 or more.")
    set_threads(config["num_threads"])
    model = load_model(config["ckpt"], config["device"], config["change"], sleeping=config["sleeping"])
    protocol = choose_protocol(config["protocol"], model.config.get("protocol"))
    manifest = data_set(config["data"]["folder"], model.config)
    seen = seen_in_training(manifest, protocol, model.trained_on, force=config["force"])
    name = "evaluation" if protocol.split == "test" else f"evaluation_{protocol.split}"
    folder = choose_folder(config["out"], beside_checkpoint(model.path, name))
    print(f"{model.name}, step {model.step}: {model.path}", flush=True)
    _require_predictions(model)
    from vpd_lightning.evaluation.summary import summary_lines  # behind the first line: it imports what measures

    with OutputFolder(folder) as partial:
        metrics = _write_evaluation(partial, model, manifest, protocol, config, seen)
    path = folder / "metrics.json"
    print("\n".join(summary_lines(metrics)))
    print()
    print(path)
    return path


_LATER_KEYS = {"draw_references": False}
"""What protocols of older runs do not say, as they were evaluated."""


def choose_protocol(wanted: Mapping[str, Any], run_protocol: Mapping[str, Any] | None) -> Protocol:
    """Return the protocol: what the run's configuration says, with the values that are set replacing its own.

    Raises:
        ConfigError: the run has no protocol (an old checkpoint) and none was chosen, or a value is out of range.
    """
    may_be_null = ("num_trajectories", *_LATER_KEYS)
    whole = all(value is not None for key, value in wanted.items() if key not in may_be_null)
    values = dict(wanted) if whole else {**(run_protocol or {}), **{k: v for k, v in wanted.items() if v is not None}}
    values |= {
        key: default for key, default in _LATER_KEYS.items() if values.get(key) is None and (whole or run_protocol)
    }
    missing = [key for key in wanted if key not in values]
    if missing:
        raise ConfigError(f"The run does not say how to evaluate it ({missing[0]} is missing).\nSet protocol=paper.")
    return Protocol(**{key: values[key] for key in wanted})


def _write_evaluation(
    folder: Path,
    model: LoadedModel,
    manifest: Manifest,
    protocol: Protocol,
    config: Mapping[str, Any],
    seen: Mapping[str, Any],
) -> dict[str, Any]:
    """Evaluate, write all files, and return the content of ``metrics.json``."""
    from vpd_lightning.evaluation.gallery import write_gallery
    from vpd_lightning.evaluation.report import metrics_of, write_metrics
    from vpd_lightning.evaluation.rollouts import write_rollouts
    from vpd_lightning.evaluation.web_page import write_web_page

    evaluation = _evaluate(model, manifest, protocol, config)
    metrics = metrics_of(evaluation, protocol, {**_identity(model, manifest, config), "seen_in_training": seen})
    write_gallery(folder, metrics, evaluation, config["num_videos"])
    write_rollouts(folder / "rollouts.npz", evaluation)
    if model.checkpoint is not None:
        _write_config(folder / "config.yaml", model.checkpoint["hyper_parameters"])
    metrics["training"] = None if model.checkpoint is None else training_of(model.checkpoint, model.path)
    write_metrics(folder, metrics, evaluation)
    write_web_page(folder, metrics)
    return metrics


def _require_predictions(model: LoadedModel) -> None:
    from vpd_lightning.evaluation.prediction import PredictsVideo, PredictsViews

    if not isinstance(model.simulator, PredictsVideo | PredictsViews):
        raise ConfigError(
            f"{model.path} holds a {type(model.simulator).__name__}, which predicts no video.\n"
            "Evaluate the training that it was made for, once that is done."
        )


def _evaluate(model: LoadedModel, manifest: Manifest, protocol: Protocol, config: Mapping[str, Any]) -> "Evaluation":
    from vpd_lightning.evaluation.evaluate import evaluate
    from vpd_lightning.evaluation.rollouts import MAX_CLIPS

    num_kept = max(config["num_videos"], MAX_CLIPS)
    try:
        with show_progress() as progress:
            return evaluate(
                model.simulator, manifest, protocol, model.input_views, num_kept, progress,
                hide_depth=config["hide_depth"],
            )  # fmt: skip
    except torch.OutOfMemoryError as error:
        raise OutOfMemoryError(
            "The device ran out of memory while rendering.\nUse device=cpu, or a device with more memory."
        ) from error


def _write_config(path: Path, config: Mapping[str, Any]) -> None:
    """Keep the settings the weights were trained with; those in the run folder are of its first start."""
    path.write_text(yaml.safe_dump(config, sort_keys=False), encoding="utf-8")


def training_of(content: Mapping[str, Any], checkpoint: Path) -> dict[str, Any]:
    """Describe the training behind a checkpoint: as ``training_time.json``, but of these weights; null: not known.

    ``seconds`` includes ``seconds_before`` (of a first training and what it prepared). ``data_sha256`` is the digest of
    the data set that was trained on, or all of them, in order, for a training that went on with another one.
    """
    data = content.get(DATA_SHA256) or [None]
    state = (content.get("callbacks") or {}).get("TimeBudget") or {}
    budget = ((content.get("hyper_parameters") or {}).get("callbacks") or {}).get("time_budget") or {}
    seconds, before = state.get("seconds"), state.get("seconds_before")
    return {
        "seconds": None if seconds is None else seconds + (before or 0.0),
        "seconds_before": before,
        "minutes_allowed": budget.get("minutes"),
        "clock": budget.get("clock"),
        "steps": state.get("steps", content.get("global_step")),
        "checkpoint_name": checkpoint.name,
        "data_sha256": data[0] if len(data) == 1 else data,
    }


def _identity(model: LoadedModel, manifest: Manifest, config: Mapping[str, Any]) -> dict[str, Any]:
    """What was evaluated, and how it was asked to differ from its training."""
    parameters = list(model.simulator.parameters())
    return {
        "model": model.name,
        "system": model.config.get("system", _DEFAULT_SYSTEM),
        "experiment": model.name,
        "seed": model.config.get("seed"),
        "num_parameters": sum(parameter.numel() for parameter in parameters),
        "checkpoint": str(model.path),
        "checkpoint_sha256": model.sha256,
        "step": model.step,
        "data": str(manifest.folder),
        "data_sha256": manifest.digest,
        "device": str(parameters[0].device),
        "hide_depth": config["hide_depth"],
        "sleeping": config["sleeping"],
        "change": config["change"],
    }
