"""Trainings in two parts: the first one, and how its weights, its stored codes and its time reach the second."""

import json
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lightning.pytorch import Callback, LightningDataModule
from lightning.pytorch.utilities import rank_zero_only

from vpd_lightning.config import pretraining_config
from vpd_lightning.config.migrations import upgraded
from vpd_lightning.config.pretraining import FOLDER
from vpd_lightning.data.views.slot_store import INDEX_FILE
from vpd_lightning.data.views.view_datamodule import FOLDER as SLOTS
from vpd_lightning.errors import CheckpointError, ConfigError
from vpd_lightning.files import AtomicPath
from vpd_lightning.loading import read_stored
from vpd_lightning.release.release_folder import is_release, read_release
from vpd_lightning.release.results_folder import run_folder
from vpd_lightning.runs.resume import has_own_checkpoint
from vpd_lightning.system import AbstractSystem
from vpd_lightning.training.callbacks.time_budget import FILE as TIME_FILE
from vpd_lightning.training.callbacks.time_budget import TimeBudget
from vpd_lightning.training.checkpoints import find_resume

DONE_FILE = "done.json"
PREPARATION_FILE = "preparation.json"
"""What it took to make the slots it lies beside: seconds, and by which clock."""
_STAGES = ("encoder", "dynamics", "renderer")
# How something is computed, not what; and how many pixels become particles, which no weight depends on.
_IGNORED, _IGNORED_END = ("ray_chunk_size", "checkpoint_chunks", "compile", "num_particles"), "_backend"

log = logging.getLogger(__name__)

Fit = Callable[..., None]


@dataclass(frozen=True)
class FirstTraining:
    """What the first training left: its checkpoint or released weights, and the seconds that it used.

    0 seconds: unknown and without a limit, or released weights, whose training the card describes.
    """

    checkpoint: Path
    seconds: float


def train_first(
    folder: Path, config: dict[str, Any], overrides: Sequence[str], is_rank_zero: bool, fit: Fit
) -> FirstTraining | None:
    """Do what ``pretraining`` asks for, as far as it is not done yet; None where it asks for nothing.

    Raises:
        CheckpointError: ``pretraining.ckpt`` names no good checkpoint and no released model.
        ConfigError: there is a time budget, and what the first training used is unknown, or all of it.
    """
    first_config = pretraining_config(config)
    if first_config is None:
        return None
    given = config["pretraining"]["ckpt"]
    if given and is_release(Path(given).expanduser()):
        return FirstTraining(_released(Path(given).expanduser()), 0.0)
    if given:
        checkpoint = find_resume(Path(given).expanduser())
        seconds = _seconds_used(run_folder(checkpoint), config)
        for budget in _budgets(config):
            _require_time_left(seconds, budget["minutes"])
        return FirstTraining(checkpoint, seconds)
    inner = folder / FOLDER
    if not (inner / DONE_FILE).is_file():
        inner.mkdir(parents=True, exist_ok=True)
        if is_rank_zero:
            print("first of two trainings:", flush=True)
        checkpoint_before = find_resume(inner) if has_own_checkpoint(inner) else None
        fit(inner, first_config, overrides, is_rank_zero, checkpoint_before, None)
        if is_rank_zero:
            (inner / DONE_FILE).write_text(json.dumps({"done": True}) + "\n", encoding="utf-8")
            print("second training:", flush=True)
    return FirstTraining(find_resume(inner), _seconds_used(inner, config))


def _released(folder: Path) -> Path:
    """Return the file of released weights. What made them is no part of this run's time."""
    path = read_release(folder).path
    log.info("the training behind %s is not counted in the time of this one; its card says what it took", path.parent)
    return path


def hand_over(
    first: FirstTraining,
    system: AbstractSystem,
    datamodule: LightningDataModule,
    callbacks: Sequence[Callback],
    folder: Path,
    config: Mapping[str, Any],
) -> list[str] | None:
    """Load the weights of the first training by name, let the data prepare what they need of it, count its time.

    Returns the SHA-256 of each trajectory that the first training saw; None where its checkpoint does not say.

    Raises:
        CheckpointError: the second system differs from the first in what it takes from it.
        ConfigError: no time is left for the second training.
    """
    trained_on = load_pretrained(system, first.checkpoint, config)
    budgets = [callback for callback in callbacks if isinstance(callback, TimeBudget)]
    prepare = getattr(datamodule, "prepare", None)
    if prepare is None:
        spent = [0.0 for _ in budgets]
    else:
        spent = _prepared(lambda: prepare(system, folder, first.checkpoint), _place(datamodule, folder), budgets)
    for budget, seconds in zip(budgets, spent, strict=True):
        budget.seconds_before = first.seconds + seconds
        _require_time_left(budget.seconds_before, budget.minutes)
    return trained_on


def _place(datamodule: Any, folder: Path) -> Path:
    shared = getattr(datamodule, "slot_folder", None)
    return folder / SLOTS if shared is None else Path(shared).expanduser()


def _prepared(prepare: Callable[[], None], place: Path, budgets: Sequence[TimeBudget]) -> list[float]:
    """Prepare; return by the clock of each budget what that took, or had taken the run that did it (0: unknown)."""
    was_there = (place / INDEX_FILE).is_file()
    before = [budget.now() for budget in budgets]
    prepare()
    spent = [budget.now() - start for budget, start in zip(budgets, before, strict=True)]
    path = place / PREPARATION_FILE
    if not was_there:
        if budgets and place.is_dir() and not rank_zero_only.rank:
            content = {budget.clock: seconds for budget, seconds in zip(budgets, spent, strict=True)}
            with AtomicPath(path) as partial:
                partial.write_text(json.dumps(content) + "\n", encoding="utf-8")
        return spent
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
        return [float(stored[budget.clock]) for budget in budgets]
    except (OSError, ValueError, KeyError, TypeError):
        log.warning("what it took to make the slots in %s is unknown and does not count", place)
        return spent


def load_pretrained(system: AbstractSystem, checkpoint: Path, config: Mapping[str, Any]) -> list[str] | None:
    """Copy all weights of a checkpoint into a system that has them under the same names; the others stay as they are.

    Returns the SHA-256 of each trajectory that the weights were trained on; None where the checkpoint does not say.

    Args:
        system: of the second training.
        checkpoint: of the first training, or released weights.
        config: what ``system`` was built from.

    Raises:
        CheckpointError: a weight has no place, or another shape; what holds the weights has other settings; a weight
            that the second training leaves as it is does not come from the first.
    """
    stored = read_stored(checkpoint)
    weights = stored.weights
    own = system.state_dict()
    homeless = sorted(name for name in weights if name not in own)
    if homeless:
        raise CheckpointError(
            f"{checkpoint} holds {homeless[0]}, a weight that the second training's model does not have.\n"
            "Both trainings need the same encoder and renderer; see pretraining.settings."
        )
    try:
        system.load_state_dict(weights, strict=False)
    except RuntimeError as error:
        detail = " ".join(str(error).split())
        raise CheckpointError(f"{checkpoint} does not fit the second training's model.\n{detail[:300]}") from error
    _require_same_settings(checkpoint, weights, stored.config or {}, config)
    for name, parameter in system.named_parameters():
        if not parameter.requires_grad and name not in weights:
            raise CheckpointError(
                f"{checkpoint} lacks {name}, which the second training does not learn.\n"
                "Name a checkpoint of the first training that belongs to this model: pretraining.ckpt=RUN"
            )
    log.info("took %d of %d weights from %s", len(weights), len(own), checkpoint)
    return None if stored.trained_on is None else sorted(stored.trained_on)


def _require_same_settings(
    checkpoint: Path, weights: Mapping[str, Any], stored: Mapping[str, Any], config: Mapping[str, Any]
) -> None:
    """Weights mean the same only under the same settings: of stages, and of the SAVi inside a SlotFormer."""
    first = upgraded(stored)
    sections = {
        name: (first.get(name), config.get(name))
        for name in _STAGES
        if any(key.startswith(f"{name}.") for key in weights)
    }
    savi = (config.get("model") or {}).get("savi")
    if savi is not None:
        sections["model.savi"] = ((first.get("model") or {}).get("savi"), savi)
    for name, (old, new) in sections.items():
        if found := _first_difference(old, new, name):
            raise CheckpointError(
                f"{checkpoint} was trained with {found[0]}={found[1]}, but the second training has {found[2]}.\n"
                "Give both trainings the same, or name another checkpoint: pretraining.ckpt=RUN"
            )


def _first_difference(old: Any, new: Any, where: str) -> tuple[str, Any, Any] | None:
    """Return key, old and new value of the first setting that differs and matters."""
    if not (isinstance(old, Mapping) and isinstance(new, Mapping)):
        return None if old == new else (where, old, new)
    for key in dict.fromkeys([*new, *old]):
        if key in _IGNORED or str(key).endswith(_IGNORED_END):
            continue
        if key not in old or key not in new:
            return f"{where}.{key}", old.get(key, "(not set)"), new.get(key, "(not set)")
        if found := _first_difference(old[key], new[key], f"{where}.{key}"):
            return found
    return None


def _budgets(config: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return the section of the time budget where it limits the training."""
    budget = (config.get("callbacks") or {}).get("time_budget")
    return [budget] if budget and budget["minutes"] is not None else []


def _seconds_used(run: Path, config: Mapping[str, Any]) -> float:
    """Read what a training used; without a limit to hold it against, 0 where that is unknown."""
    path = run / TIME_FILE
    way_out = "Name a first training that was timed the same way, or set callbacks.time_budget.minutes=null."
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        seconds, clock = float(content["seconds"]), content["clock"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        if not _budgets(config):
            return 0.0
        raise ConfigError(
            f"{path} cannot be read, so how much of the time budget the first training used is unknown.\n{way_out}"
        ) from error
    for budget in _budgets(config):
        if clock != budget["clock"]:
            raise ConfigError(
                f"{path} was measured with callbacks.time_budget.clock={clock}, but this training has"
                f" {budget['clock']}.\n{way_out}"
            )
    return seconds


def _require_time_left(seconds: float, minutes: float | None) -> None:
    if minutes is not None and seconds >= 60.0 * minutes:
        raise ConfigError(
            f"the first training and the preparation of the second took {seconds:.0f} s: nothing is left of the time"
            f" budget of {60.0 * minutes:.0f} s.\n"
            "Raise callbacks.time_budget.minutes, or lower pretraining.share."
        )
