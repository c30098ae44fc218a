"""From a trained system to a folder that can be given away: weights, settings, figures and a card."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import yaml
from torch import Tensor, nn

from vpd_lightning.data.trained_on import TRAINED_ON
from vpd_lightning.errors import CheckpointError, ConfigError
from vpd_lightning.metrics.registry import HEADLINE, blocks, image_metrics
from vpd_lightning.release.model_card import CardContent, model_card
from vpd_lightning.release.portable import absolute_paths, portable_config, portable_metrics
from vpd_lightning.release.release_folder import (
    CARD_FILE,
    CHECKED_FILES,
    CONFIG_FILE,
    FORMAT_VERSION,
    INDEX_FILE,
    METRICS_FILE,
    PROGRAM_FILE,
    WEIGHTS_FILE,
    check_release,
    folder_bytes,
    sha256,
)
from vpd_lightning.release.results_folder import run_folder

_MEGABYTE = 10**6


@dataclass(frozen=True)
class TrainedSystem:
    """What is released: a system with its trained weights, its plain configuration, its checkpoint and its update.

    ``sha256`` is that of the checkpoint; ``trained_on`` holds those of the trajectories that a training saw, where
    known.
    """

    system: nn.Module
    config: Mapping[str, Any]
    checkpoint: Path
    step: int
    sha256: str
    trained_on: frozenset[str] | None


def find_metrics(trained: TrainedSystem, metrics_file: str | None) -> dict[str, Any]:
    """Read the figures to publish: a given file, or those that ``vpd-eval`` wrote in the run folder.

    Raises:
        ConfigError: there are none, they are no figures, or they are those of another checkpoint.
    """
    default = run_folder(trained.checkpoint) / "evaluation" / METRICS_FILE
    path = Path(metrics_file).expanduser() if metrics_file else default
    try:
        metrics = json.loads(path.read_text(encoding="utf-8"), parse_constant=_refuse_constant)
    except FileNotFoundError:
        raise ConfigError(
            f"There are no figures in {path}, and no model is released without.\n"
            f"Measure it first: vpd-eval ckpt={trained.checkpoint}; or name a file: metrics=FILE."
        ) from None
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path} cannot be read: {error}.\nGive metrics=FILE, as vpd-eval writes it.") from error
    wanted = ("checkpoint_sha256", "protocol", HEADLINE, "references")
    missing = [name for name in wanted if not isinstance(metrics, dict) or name not in metrics]
    if missing:
        raise ConfigError(f"{path} lacks {', '.join(missing)}.\nGive metrics=FILE, as vpd-eval writes it.")
    wrong = _wrong_entry(metrics)
    if wrong is not None:
        raise ConfigError(f"{path}: {wrong} is not what vpd-eval writes.\nGive metrics=FILE, as vpd-eval writes it.")
    _require_plain_test(metrics, path, trained.checkpoint)
    if metrics["checkpoint_sha256"] != trained.sha256:
        raise ConfigError(
            f"{path} has the figures of another checkpoint than {trained.checkpoint}.\n"
            f"Measure this one: vpd-eval ckpt={trained.checkpoint}; then metrics=FILE with its metrics.json."
        )
    return metrics


def _wrong_entry(metrics: Mapping[str, Any]) -> str | None:
    """Return the name of an entry that a card needs and that is of another kind."""
    kinds: dict[str, tuple[Any, Any]] = {"protocol": (metrics["protocol"], Mapping)}
    kinds["checkpoint_sha256"] = (metrics["checkpoint_sha256"], str)
    for info in image_metrics():
        if info.name in metrics:
            kinds[info.name] = (metrics[info.name], Mapping)
    references = metrics["references"]
    kinds["references"] = (references, Mapping)
    for name in references if isinstance(references, Mapping) else ():
        kinds[f"references.{name}"] = (references[name], Mapping)
    for name in (*(info.name for info in blocks()), "motion", "native", "long_rollout"):
        kinds[name] = (metrics.get(name), Mapping | None)
    wrong = next((name for name, (value, kind) in kinds.items() if not isinstance(value, kind)), None)
    if wrong is not None:
        return wrong
    mean = metrics[HEADLINE].get("mean")
    return None if isinstance(mean, int | float) and not isinstance(mean, bool) else f"{HEADLINE}.mean"


def _require_plain_test(metrics: Mapping[str, Any], path: Path, checkpoint: Path) -> None:
    """A card says how good the model is as it was trained, on what it was not tuned on."""
    again = f"Measure it as it was trained: vpd-eval ckpt={checkpoint}; then metrics=FILE with its metrics.json."
    differs = [name for name in ("change", "sleeping", "hide_depth") if metrics.get(name)]
    if differs:
        raise ConfigError(f"{path} was measured with {differs[0]}={metrics[differs[0]]}.\n{again}")
    split = metrics["protocol"].get("split")
    if split != "test":
        raise ConfigError(f"{path} is about the {split} split; a card reports the test split.\n{again}")
    count = (metrics.get("seen_in_training") or {}).get("trajectories")
    if count:
        raise ConfigError(
            f"{path} includes {count} trajectories that were trained on; a card reports unseen ones only.\n"
            "Measure it on a test split that no training saw; `vpd-eval data.folder=FOLDER` chooses the data set."
        )


def write_release(
    folder: Path, trained: TrainedSystem, metrics: Mapping[str, Any], *, name: str, max_megabytes: float
) -> None:
    """Write a released model called ``name`` into a folder that is empty, or holds a renderer's program.

    Raises:
        ConfigError: it would be larger than ``max_megabytes``, or cannot be freed of this machine's paths.
        CheckpointError: float32 cannot hold the weights.
    """
    if max_megabytes <= 0:
        raise ConfigError(f"max_megabytes={max_megabytes} is out of range.\nAllowed: numbers above 0.")
    config, figures = portable_config(trained.config), portable_metrics(metrics)
    weights = float32_weights(trained.system)
    content = {
        WEIGHTS_FILE: _weight_bytes(weights),
        CONFIG_FILE: _yaml(config).encode(),
        METRICS_FILE: (json.dumps(figures, indent=1, allow_nan=False) + "\n").encode(),
    }
    num_parameters = sum(parameter.numel() for parameter in trained.system.parameters())
    index = {
        "format_version": FORMAT_VERSION,
        "name": name,
        "system": system_name(trained.config),
        "experiment": str(config.get("experiment", "custom")),
        "seed": config.get("seed"),
        "step": trained.step,
        "num_parameters": num_parameters,
        HEADLINE: figures[HEADLINE]["mean"],
        "sha256": {file: sha256(content[file]) for file in CHECKED_FILES} | _program_digest(folder),
        TRAINED_ON: None if trained.trained_on is None else sorted(trained.trained_on),
    }
    environment = _run_file(trained.checkpoint, "environment.json") or {}
    card = CardContent(
        name=name,
        index=index,
        config=config,
        metrics=figures,
        training=_run_file(trained.checkpoint, "training_time.json"),
        environment={key: environment.get(key) for key in ("versions", "devices", "git_commit")},
        megabytes=len(content[WEIGHTS_FILE]) / _MEGABYTE,
    )
    left = [*absolute_paths(config, "config"), *absolute_paths(figures, "metrics")]
    if left:
        raise ConfigError(f"{left[0]} is a path of this machine.\nTrain with relative paths, then export.")
    for file, text in content.items():
        (folder / file).write_bytes(text)
    (folder / INDEX_FILE).write_text(json.dumps(index, indent=1) + "\n", encoding="utf-8")
    (folder / CARD_FILE).write_text(model_card(card), encoding="utf-8")
    _require_size(folder, max_megabytes, num_parameters)


def copy_release(source: Path, folder: Path, *, max_megabytes: float) -> None:
    """Copy a released model into a folder that is empty, or holds a renderer's program, which then belongs to it.

    Raises:
        CheckpointError: the source is not whole.
        ConfigError: the copy would be larger than ``max_megabytes``.
    """
    index = check_release(source)
    for file in (*CHECKED_FILES, CARD_FILE):
        (folder / file).write_bytes((source / file).read_bytes())
    index["sha256"] = {file: index["sha256"][file] for file in CHECKED_FILES} | _program_digest(folder)
    (folder / INDEX_FILE).write_text(json.dumps(index, indent=1) + "\n", encoding="utf-8")
    _require_size(folder, max_megabytes, index["num_parameters"])


def _program_digest(folder: Path) -> dict[str, str]:
    path = folder / PROGRAM_FILE
    return {PROGRAM_FILE: sha256(path.read_bytes())} if path.is_file() else {}


def _require_size(folder: Path, max_megabytes: float, num_parameters: int) -> None:
    size = folder_bytes(folder) / _MEGABYTE
    if size > max_megabytes:
        raise ConfigError(
            f"The model takes {size:.1f} MB, and at most {max_megabytes:g} are allowed.\n"
            f"It has {num_parameters:,} parameters. Release a smaller one, or set max_megabytes={size + 1:.0f}."
        )


def float32_weights(system: nn.Module) -> dict[str, Tensor]:
    """Return the state dict on the CPU: floats as float32, whole numbers and flags as they are, no shared memory.

    Raises:
        CheckpointError: a value would change.
    """
    weights = {}
    for name, value in system.state_dict().items():
        kept = value.detach().cpu()
        if kept.is_floating_point():
            kept = kept.to(torch.float32)
            if not torch.equal(kept.to(value.dtype), value.detach().cpu()):
                raise CheckpointError(
                    f"{name} holds {value.dtype} numbers that float32 cannot hold; nothing was written."
                )
        weights[name] = kept.clone(memory_format=torch.contiguous_format)
    return weights


def system_name(config: Mapping[str, Any]) -> str:
    """Return the configuration's ``system``; for runs from before it had a name, from their dynamics."""
    if "system" in config:
        return str(config["system"])
    dynamics = config.get("dynamics") or {}
    return "inertial" if str(dynamics.get("_target_")).endswith(".InertialDynamics") else "vpd"


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is no figure")


def _weight_bytes(weights: Mapping[str, Tensor]) -> bytes:
    import safetensors.torch

    return safetensors.torch.save(dict(weights), metadata={"format": "pt"})


def _yaml(config: Mapping[str, Any]) -> str:
    class Dumper(yaml.SafeDumper):
        """Writes lists out each time they occur, because anchors are refused on reading."""

        def ignore_aliases(self, data: Any) -> bool:
            return True

    return yaml.dump(dict(config), Dumper=Dumper, sort_keys=False, allow_unicode=True)


def _run_file(checkpoint: Path, name: str) -> dict[str, Any] | None:
    path = run_folder(checkpoint) / name
    if not path.is_file():
        return None
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path} cannot be read: {error}.\nIt belongs to the run; restore it.") from error
    return content if isinstance(content, dict) else None
