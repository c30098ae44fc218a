"""Which settings tell the runs of one system apart."""

from collections.abc import Hashable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from vpd_lightning.comparison.run import Run
from vpd_lightning.data.manifest import load_manifest
from vpd_lightning.errors import VPDError

# Settings that change what a run says, keeps or costs, but not what it learns; and those with columns of their own.
_NOT_COMPARED = (
    "experiment", "system", "size", "seed", "sweep_name", "evaluate", "run", "resume", "debug", "force", "num_threads",
    "logger", "protocol", "generate", "pretraining.ckpt", "data.folder", "data.num_workers", "data.cache",
    "data.num_validation_clips", "data.num_validation_steps", "data.validation_views", "trainer.default_root_dir",
    "trainer.log_every_n_steps", "trainer.enable_progress_bar", "trainer.enable_model_summary",
    "trainer.val_check_interval", "trainer.check_val_every_n_epoch", "trainer.limit_val_batches",
    "trainer.num_sanity_val_steps", "callbacks.progress", "callbacks.draw_rollouts", "callbacks.keep_checkpoints",
    "callbacks.log_metrics", "callbacks.stop_on_signal",
)  # fmt: skip
# What decides how much a training gets done in a given time; elsewhere it changes nothing.
PACE = ("num_threads", "data.num_workers", "data.cache", "trainer.accelerator")
TRAJECTORIES, VIEWS, PARTICLES = "data.num_trajectories", "scene.input_views", "encoder.num_particles"
# The paper's axes first: where several settings change together, the first one names the row.
_NAMED_FIRST = (TRAJECTORIES, VIEWS, PARTICLES, "scene.location_noise", "data.num_steps")


def comparable_settings(run: Run) -> dict[str, Hashable]:
    """Flatten a run's configuration to dotted keys, without what does not change what is learnt.

    "All trajectories" becomes their number, where the data set is still there to count them.
    """
    folder = str((run.config.get("trainer") or {}).get("default_root_dir") or run.folder.absolute())
    flat: dict[str, Hashable] = {}
    _flatten("", run.config, flat)
    flat.update({name: value for name, value in run.asked_to_differ})
    if TRAJECTORIES in flat and flat[TRAJECTORIES] is None:
        flat[TRAJECTORIES] = _num_trajectories(str(run.metrics.get("data")))
    free = [name for name in _NOT_COMPARED if run.minutes_allowed is None or name not in PACE]
    return {
        key: value
        for key, value in flat.items()
        if not any(key == name or key.startswith(f"{name}.") for name in free)
        and key.rpartition(".")[2] != "seed"
        and not (folder and isinstance(value, str) and value.startswith(folder))
    }


@cache
def _num_trajectories(folder: str) -> int | None:
    try:
        return len(load_manifest(Path(folder)).splits.get("train") or ()) or None
    except (VPDError, OSError):
        return None


def _flatten(place: str, value: Any, flat: dict[str, Hashable]) -> None:
    if isinstance(value, Mapping) and value:
        for key, item in value.items():
            _flatten(f"{place}.{key}" if place else str(key), item, flat)
    elif isinstance(value, list):
        flat[place] = tuple(str(item) if isinstance(item, list | Mapping) else item for item in value)
    else:
        flat[place] = value if isinstance(value, Hashable) else str(value)


def differing(settings: Sequence[Mapping[str, Hashable]]) -> list[str]:
    """Return the keys that do not have one value in all of ``settings``; a missing key is a value of its own."""
    keys = list(dict.fromkeys(key for one in settings for key in one))
    return [key for key in keys if len({comparable(one, key) for one in settings}) > 1]


def naming_keys(settings: Sequence[Mapping[str, Hashable]], first: Sequence[str] = ()) -> list[str]:
    """Choose few keys that tell all ``settings`` apart.

    Keys of ``first`` come first, then which class a stage has, then the axes of the paper's figures, then the rest;
    a key is taken when it separates what those before it do not. So interpolated copies of a value, and what follows
    from another class, do not show up.
    """
    keys = differing(settings)
    targets = sorted((key for key in keys if key.endswith("_target_")), key=lambda key: key.count("."))
    ordered = dict.fromkeys([*(key for key in first if key in keys), *targets, *_NAMED_FIRST, *keys])
    chosen: list[str] = []
    groups = 1
    for key in ordered:
        separated = len({tuple(comparable(one, name) for name in [*chosen, key]) for one in settings})
        if key in keys and separated > groups:
            chosen, groups = [*chosen, key], separated
    return chosen


def shown(key: str, value: Hashable) -> str:
    """A setting as one types it; a stage's class by its short name."""
    if key.endswith("._target_"):
        return f"{key.removesuffix('._target_')}={str(value).rpartition('.')[2]}"
    if isinstance(value, tuple):
        return f"{key}=[{','.join(str(item) for item in value)}]"
    words = {None: "null", True: "true", False: "false"}
    return f"{key}={words[value] if value is None or isinstance(value, bool) else value}"


def label(settings: Mapping[str, Hashable], keys: Sequence[str]) -> str:
    """Name settings by some of their keys."""
    return ", ".join(shown(key, settings[key]) for key in keys if key in settings)


def comparable(settings: Mapping[str, Hashable], key: str) -> Hashable:
    """Return a value to compare: 1 and 1.0 are the same setting, true is another, and so is one that is not there."""
    return key in settings, isinstance(settings.get(key), bool), settings.get(key)
