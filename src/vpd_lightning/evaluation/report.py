"""The results of an evaluation: ``metrics.json``, ``metrics.csv``, ``arrays.npz`` and a compact table."""

import csv
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vpd_lightning.evaluation.evaluate import Evaluation
from vpd_lightning.evaluation.events import events_of
from vpd_lightning.evaluation.long_rollout import LongRollout
from vpd_lightning.evaluation.protocol import Protocol
from vpd_lightning.evaluation.statistics import plain, pooled_psnr, summarize
from vpd_lightning.files import AtomicPath
from vpd_lightning.metrics.metric_info import MetricInfo
from vpd_lightning.metrics.registry import (
    HEADLINE,
    REFERENCES,
    SOURCES,
    blocks,
    image_metrics,
    motion_metrics,
    referenced,
    references_of,
)

FORMAT_VERSION = 1


def metrics_of(evaluation: Evaluation, protocol: Protocol, identity: Mapping[str, Any]) -> dict[str, Any]:
    """Build the content of ``metrics.json``; ``identity`` names the model, the checkpoint and the data.

    Every metric is an object with ``mean`` (over images), ``ci95`` (bootstrap over trajectories) and ``per_step``;
    distances are metres; ``events`` are figures over bodies. Values that do not exist are null: a system without
    particles has no ``motion``, ``events`` and ``long_rollout`` and nothing else that is measured of particles, one
    that predicts at the resolution of the truth has no ``native``, and ``drawn`` has the motions that were drawn.
    """
    systems = {system: _image_summary(evaluation, protocol, evaluation.images[system]) for system in SOURCES}
    summary = _summarizer(evaluation, protocol)
    return {
        "format_version": FORMAT_VERSION,
        **identity,
        "protocol": {
            **protocol.as_dict(),
            "input_views": evaluation.input_views,
            "num_views": int(evaluation.images["model"][HEADLINE].shape[1]),
            "num_clips": len(evaluation.clips),
            "num_trajectories": int(np.unique(evaluation.trajectory).size),
        },
        "finite": evaluation.finite,
        **systems["model"],
        "native": _native_summary(evaluation, protocol),
        **{info.name: _parts_summary(evaluation.blocks.get(info.name), summary) for info in blocks()},
        "reconstruction": {name: summary(values)["mean"] for name, values in evaluation.reconstruction.items()},
        "references": {system: systems[system] for system in REFERENCES},
        "drawn": {motion: _image_summary(evaluation, protocol, arrays) for motion, arrays in evaluation.drawn.items()}
        or None,
        "motion": _motion_summary(evaluation, protocol),
        "events": events_of(evaluation.motion),
        "long_rollout": _long_summary(evaluation.long_rollouts),
        "seconds": {name: plain(value) for name, value in evaluation.seconds.items()},
    }


def _summarizer(evaluation: Evaluation, protocol: Protocol) -> Any:
    return lambda values: summarize(values, evaluation.trajectory, protocol.num_bootstrap)


def _image_summary(
    evaluation: Evaluation, protocol: Protocol, arrays: Mapping[str, NDArray[np.float64]]
) -> dict[str, Any]:
    summary = _summarizer(evaluation, protocol)
    num_views = arrays[HEADLINE].shape[1]
    inputs = np.isin(np.arange(num_views), evaluation.input_views)
    result = {}
    for info in image_metrics():
        values = arrays[info.name]
        result[info.name] = summary(values)
        result[info.name]["input_views"] = summary(values[:, inputs])["mean"]
        result[info.name]["other_views"] = summary(values[:, ~inputs])["mean"]
        if info.pooled_part is not None:
            result[info.name]["pooled"] = pooled_psnr(arrays[info.pooled_part])
    return result


def _native_summary(evaluation: Evaluation, protocol: Protocol) -> dict[str, Any] | None:
    """Means at the system's own resolution, against the truth made as small."""
    if not evaluation.native:
        return None
    summary = _summarizer(evaluation, protocol)
    means = {info.name: summary(evaluation.native[info.name])["mean"] for info in image_metrics()}
    return {"resolution": evaluation.resolution, **means}


def _parts_summary(parts: Mapping[str, NDArray[np.float64]] | None, summary: Any) -> dict[str, Any] | None:
    """Summarise the first part, the metric itself; of the others only the mean counts."""
    if not parts:
        return None
    first, *others = parts
    return {**summary(parts[first]), **{name: summary(parts[name])["mean"] for name in others}}


def _motion_summary(evaluation: Evaluation, protocol: Protocol) -> dict[str, Any] | None:
    if not evaluation.motion:
        return None
    summary = _summarizer(evaluation, protocol)
    result = {name: summary(values) for name, values in evaluation.motion.items()}
    for info in motion_metrics():
        if info.has_extremes:
            result[info.name]["min"] = plain(np.nanmin(evaluation.motion[info.name], initial=np.inf))
            result[info.name]["max"] = plain(np.nanmax(evaluation.motion[info.name], initial=-np.inf))
    for info in referenced():
        for reference in references_of(info):
            result[ratio_name(reference)] = _ratio(evaluation.motion[info.name], evaluation.motion[reference.name])
    return result


def ratio_name(reference: MetricInfo) -> str:
    """Return the name of the ratio of a metric's errors to those of its reference: ``centroid_error_over_copy``."""
    return f"{reference.reference_of}_over_{reference.name.removeprefix(f'{reference.reference_of}_')}"


def _ratio(error: NDArray[np.float64], reference: NDArray[np.float64]) -> dict[str, Any]:
    """Ratio of the mean errors at each step (the last axis), over those objects of clips that have both."""
    both = ~np.isnan(error) & ~np.isnan(reference)
    axes = tuple(range(both.ndim - 1))
    above, below = (np.where(both, values, 0.0).sum(axes) for values in (error, reference))
    ratios = [plain(a / b) if b > 0 else None for a, b in zip(above, below, strict=True)]
    return {"per_step": ratios, "count": int(both.sum())}


def _long_summary(rollouts: Sequence[LongRollout]) -> dict[str, Any] | None:
    """Summarise over clips and objects; ``count`` is how many clips have values, for every object of theirs.

    A clip has none where its rollout is not finite, or where its particles hardly show the object.
    """
    if not rollouts:
        return None

    def values(name: str) -> NDArray[np.float64]:
        return np.hstack([np.atleast_1d(getattr(rollout, name)) for rollout in rollouts]).astype(np.float64)

    def block(decides: str, **figures: tuple[str, Callable[[NDArray[np.float64]], Any]]) -> dict[str, Any]:
        """All figures of a block are over the same clips and objects: those whose ``decides`` is a number."""
        known = np.isfinite(values(decides))
        count = sum(bool(np.isfinite(getattr(rollout, decides)).all()) for rollout in rollouts)
        picked = {name: plain(pick(values(of)[known])) if known.any() else None for name, (of, pick) in figures.items()}
        return {**picked, "count": count}

    return {
        "num_steps": rollouts[0].num_steps,
        "num_clips": len(rollouts),
        "finite": all(rollout.finite for rollout in rollouts),
        "num_finite": sum(rollout.finite for rollout in rollouts),
        "floor_drift": block(
            "floor_drift_max",
            median=("floor_drift_median", np.median),
            p99=("floor_drift_p99", np.median),
            max=("floor_drift_max", np.max),
        ),
        "size_ratio": block(
            "size_ratio_min",
            median=("size_ratio_end", np.median),
            min=("size_ratio_min", np.min),
            max=("size_ratio_max", np.max),
        ),
        "lowest_point": block("lowest_point", median=("lowest_point", np.median), min=("lowest_point", np.min)),
        "final_speed": block("final_speed", median=("final_speed", np.median), max=("final_speed", np.max)),
        "centroid_error": block(
            "centroid_error", median=("centroid_error", np.median), copy_median=("centroid_error_copy", np.median)
        ),
        "clips": [_json_ready(asdict(rollout)) for rollout in rollouts],
    }


def _json_ready(value: Any) -> Any:
    """Replace what JSON cannot hold (NaN, infinity) by None."""
    if isinstance(value, dict):
        return {key: _json_ready(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_json_ready(item) for item in value]
    return plain(value) if isinstance(value, float) else value


def write_metrics(folder: Path, metrics: Mapping[str, Any], evaluation: Evaluation) -> Path:
    """Write ``metrics.json``, ``metrics.csv`` (one row per step) and ``arrays.npz``; returns the path of the first."""
    _write_csv(folder / "metrics.csv", metrics)
    with AtomicPath(folder / "arrays.npz") as partial, partial.open("wb") as stream:
        np.savez_compressed(stream, allow_pickle=False, **evaluation.arrays())
    path = folder / "metrics.json"
    with AtomicPath(path) as partial:
        partial.write_text(json.dumps(_json_ready(dict(metrics)), indent=1, allow_nan=False) + "\n")
    return path


def step_table(metrics: Mapping[str, Any]) -> dict[str, list[float | None]]:
    """Collect every per-step curve under a flat name; step 1 is the first predicted frame."""
    columns: dict[str, list[float | None]] = {}
    for system, values in (("model", metrics), *metrics["references"].items(), *(metrics.get("drawn") or {}).items()):
        for info in (info for info in image_metrics() if info.name in values):  # older files have fewer
            columns[f"{system}/{info.name}"] = values[info.name]["per_step"]
    for info in blocks():
        if metrics[info.name]:
            columns[f"model/{info.name}"] = metrics[info.name]["per_step"]
    for name, values in (metrics["motion"] or {}).items():
        columns[f"motion/{name}"] = values["per_step"]
    return {"step": [step + 1 for step in range(metrics["protocol"]["num_steps"])], **columns}


def _write_csv(path: Path, metrics: Mapping[str, Any]) -> None:
    columns = step_table(metrics)
    with AtomicPath(path) as partial, partial.open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(columns)
        for row in zip(*columns.values(), strict=True):
            writer.writerow(["" if value is None else f"{value:.6g}" for value in row])
