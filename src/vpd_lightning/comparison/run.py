"""One evaluated training, read from its folder."""

import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from vpd_lightning.comparison.bootstrap import sums_of
from vpd_lightning.metrics.registry import HEADLINE, SOURCES, compared, references_of

KNOWN_FORMATS = (1,)
_MAX_BYTES = 64 * 2**20
# What a protocol says that decides no column of a table, or that belongs to the system.
_FREE = ("input_views", "num_bootstrap", "num_long_steps", "long_start_frame", "num_context_frames", "draw_references")
_RELATIVE_TOLERANCE = 1e-6  # metrics.json prints float64; sums in another order differ by far less


class UnusableRunError(Exception):
    """A run that cannot stand in a report; the message says why, in one line."""


@dataclass(frozen=True, eq=False)
class Run:
    """A run folder with one of its evaluations.

    ``config`` and ``time`` are those of the evaluated checkpoint where the evaluation says them (a run that was resumed
    with other settings keeps its first ones in its folder), and else those of the run folder.
    ``samples[source, metric]`` holds totals and counts (``trajectory step``) of what ``arrays.npz`` has, ``source``
    being ``model`` or a reference; ``clips`` names the clips (empty where there are no arrays).
    """

    folder: Path
    evaluation: Path
    experiment: str
    system: str
    seed: int
    config: Mapping[str, Any]
    metrics: Mapping[str, Any]
    time: Mapping[str, Any] | None
    machine: str | None
    clips: tuple[str, ...]
    samples: Mapping[tuple[str, str], tuple[NDArray, NDArray]]

    @cached_property
    def protocol(self) -> str:
        """What was predicted and how it was measured; only what has the same may stand in one table."""
        kept = {key: value for key, value in self.metrics["protocol"].items() if key not in _FREE}
        return json.dumps(kept, sort_keys=True)

    @property
    def asked_to_differ(self) -> tuple[tuple[str, str], ...]:
        """How the evaluation differs from the training: no input depth, other settings, what rests left out, data."""
        asked = {name: self.metrics.get(name) for name in ("change", "hide_depth", "sleeping")}
        asked["evaluated_on"] = self.data_sha256[:12] if self._is_on_other_data else None
        return tuple((name, json.dumps(value, sort_keys=True)) for name, value in asked.items() if value)

    @property
    def _is_on_other_data(self) -> bool:
        digest = (self.metrics.get("training") or {}).get("data_sha256")
        if digest is not None:
            return bool(digest != self.data_sha256)
        # Older checkpoints hold no digest; then folders are compared.
        trained, evaluated = _get(self.config, "data.folder"), self.metrics.get("data")
        if not isinstance(trained, str) or not isinstance(evaluated, str):
            return False
        return trained != evaluated and Path(trained).resolve() != Path(evaluated).resolve()

    @property
    def data_sha256(self) -> str:
        """Digest of the data set it was evaluated on."""
        return str(self.metrics["data_sha256"])

    @property
    def num_bootstrap(self) -> int:
        """How many resamples the intervals of this evaluation come from."""
        return int(self.metrics["protocol"].get("num_bootstrap", 1000))

    @property
    def declared_budget(self) -> str:
        """What the training was allowed: minutes of a clock, or steps; both with its pretraining."""
        limit = _get(self.config, "callbacks.time_budget")
        if isinstance(limit, Mapping) and limit.get("minutes") is not None:
            return f"{limit['minutes']:g} min {limit.get('clock', '')}".strip()
        steps = [_get(self.config, f"{part}trainer.max_steps") for part in ("pretraining.settings.", "")]
        known = [count for count in steps if isinstance(count, int) and count > 0]
        return f"{sum(known):,} steps" if isinstance(steps[-1], int) and steps[-1] > 0 else "no limit"

    @property
    def minutes(self) -> float | None:
        """Minutes the training took, pretraining included; None where they were not written down."""
        return None if self.time is None else float(self.time["seconds"]) / 60.0

    @property
    def minutes_allowed(self) -> float | None:
        """Minutes the training was allowed, pretraining included; None without such a limit."""
        minutes = _get(self.config, "callbacks.time_budget.minutes")
        return None if minutes is None else float(minutes)

    @property
    def milliseconds_per_frame(self) -> float | None:
        """Wall time of a clip's prediction, from input frames to pictures, over its pictures; that of its machine."""
        seconds, protocol = self.metrics.get("seconds") or {}, self.metrics["protocol"]
        parts = [seconds.get(f"{part}_per_clip") for part in ("encode", "rollout", "render")]
        known = [float(part) for part in parts if part is not None]
        num_pictures = (protocol.get("num_steps") or 0) * (protocol.get("num_views") or 0)
        return 1000.0 * sum(known) / num_pictures if len(known) == len(parts) and num_pictures else None

    @property
    def checkpoint_name(self) -> str | None:
        """Which of a run's checkpoints was evaluated: ``last.ckpt``, ``best.ckpt``."""
        name = self.metrics.get("checkpoint")
        return Path(name).name if isinstance(name, str) else None

    @property
    def clock(self) -> str:
        """The clock of ``minutes``: wall or cpu."""
        return "-" if self.time is None else str(self.time.get("clock", "-"))

    @property
    def steps(self) -> int | None:
        """Optimiser steps behind the evaluated weights."""
        step = self.metrics.get("step")
        return step if isinstance(step, int) else None

    @property
    def num_parameters(self) -> int | None:
        """Trainable numbers of the system."""
        count = self.metrics.get("num_parameters")
        return count if isinstance(count, int) else None


def read_run(folder: Path, evaluation: Path) -> Run:
    """Read a run folder (``config.yaml``) and one evaluation (``metrics.json``, ``arrays.npz`` where it is there).

    Raises:
        UnusableRunError: what stands there is not enough, or contradicts itself.
    """
    of_checkpoint = evaluation / "config.yaml"
    config = _read_yaml(of_checkpoint if of_checkpoint.exists() else folder / "config.yaml")
    metrics = _read_json(evaluation / "metrics.json")
    if metrics.get("format_version") not in KNOWN_FORMATS:
        raise UnusableRunError(f"its metrics.json has format {metrics.get('format_version')!r}, not {KNOWN_FORMATS[0]}")
    for key in ("protocol", HEADLINE, "references", "data_sha256"):
        if not metrics.get(key):
            raise UnusableRunError(f"its metrics.json has no {key}; run vpd-eval again")
        if not isinstance(metrics[key], str if key == "data_sha256" else Mapping):
            raise UnusableRunError(f"the {key} of its metrics.json is not one of vpd-eval")
    names = {key: metrics.get(key, config.get(key)) for key in ("experiment", "system", "seed")}
    for key, value in names.items():
        if value is None:
            raise UnusableRunError(f"it does not say its {key} (an older version made it); run vpd-eval again")
    clips, samples = _read_samples(evaluation / "arrays.npz", metrics)
    run = Run(
        folder=folder,
        evaluation=evaluation,
        experiment=str(names["experiment"]),
        system=str(names["system"]),
        seed=int(str(names["seed"])),
        config=config,
        metrics=metrics,
        time=_time(folder, metrics),
        machine=_machine(folder / "environment.json"),
        clips=clips,
        samples=samples,
    )
    _check_contents(run)
    return run


def _time(folder: Path, metrics: Mapping[str, Any]) -> Mapping[str, Any] | None:
    training = metrics.get("training")
    if isinstance(training, Mapping):  # it knows; null seconds mean that the checkpoint does not say
        return training if training.get("seconds") is not None else None
    path = folder / "training_time.json"
    return _read_json(path) if path.exists() else None


def _machine(path: Path) -> str | None:
    devices = _read_json(path).get("devices") if path.exists() else None
    return "; ".join(str(device) for device in devices) if isinstance(devices, list) and devices else None


def _check_contents(run: Run) -> None:
    """Look at everything that a report will use: TypeError, ValueError or KeyError where it is something else."""
    for source in SOURCES:
        for summary in (info.summary(run.metrics, source) for info in compared()):
            if summary is not None:
                low, high = summary.get("ci95") or (0.0, 0.0)
                numbers = [value for value in summary.get("per_step") or () if value is not None]
                sum([summary["mean"], low, high, *numbers], 0.0)
    sorted(run.metrics["protocol"].get("input_views") or ())
    _ = run.protocol, run.num_bootstrap, run.declared_budget, run.minutes, run.minutes_allowed, run.asked_to_differ
    _ = run.milliseconds_per_frame
    run.metrics["references"].get("")


def _read_samples(path: Path, metrics: Mapping[str, Any]) -> tuple[tuple[str, ...], dict[tuple[str, str], Any]]:
    if not path.exists():
        return (), {}
    samples: dict[tuple[str, str], Any] = {}
    try:
        with np.load(path, allow_pickle=False) as arrays:
            trajectory, clips = arrays["trajectory"], tuple(str(name) for name in arrays["clip"])
            for source in SOURCES:
                references = [other for info in compared() for other in references_of(info) if source == "model"]
                for info in (*compared(), *references):
                    summary = info.summary(metrics, source)
                    name = next((name for name in info.array_names(source) if name in arrays), None)
                    if name is not None and summary is not None:
                        samples[source, info.name] = sums_of(arrays[name], trajectory)
                        _check_mean(name, samples[source, info.name], summary["mean"])
    except (OSError, ValueError, KeyError, zipfile.BadZipFile, EOFError) as error:
        raise UnusableRunError(f"its arrays.npz cannot be read ({type(error).__name__}); run vpd-eval again") from error
    return clips, samples


def _check_mean(name: str, sums: tuple[NDArray, NDArray], printed: float) -> None:
    """The arrays must say what metrics.json says: else the two are not of one evaluation."""
    total, count = float(sums[0].sum()), int(sums[1].sum())
    mean = total / count if count else float("nan")
    if not abs(mean - printed) <= _RELATIVE_TOLERANCE * max(abs(printed), 1e-9):
        raise UnusableRunError(f"{name} is {mean:.6g} in arrays.npz and {printed:.6g} in metrics.json; evaluate again")


def _read_json(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(_read_text(path))
    except ValueError:
        raise UnusableRunError(f"its {path.name} is not JSON") from None
    return _mapping(path, content)


def _read_yaml(path: Path) -> dict[str, Any]:
    try:
        content = yaml.safe_load(_read_text(path))
    except yaml.YAMLError:
        raise UnusableRunError(f"its {path.name} is not YAML") from None
    return _mapping(path, content)


def _read_text(path: Path) -> str:
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise UnusableRunError(f"its {path.name} has more than {_MAX_BYTES // 2**20} MiB")
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UnusableRunError(f"its {path.name} cannot be read ({type(error).__name__})") from error


def _mapping(path: Path, content: Any) -> dict[str, Any]:
    if not isinstance(content, dict):
        raise UnusableRunError(f"its {path.name} holds no settings")
    return content


def _get(config: Mapping[str, Any], place: str) -> Any:
    found: Any = config
    for key in place.split("."):
        found = found.get(key) if isinstance(found, Mapping) else None
    return found
