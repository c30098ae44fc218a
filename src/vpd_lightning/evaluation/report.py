"""What an evaluation says: ``metrics.json``, ``metrics.csv``, ``arrays.npz`` and a compact table."""

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
from vpd_lightning.evaluation.measuring import SYSTEMS
from vpd_lightning.evaluation.protocol import Protocol
from vpd_lightning.evaluation.statistics import plain, pooled_psnr, summarize
from vpd_lightning.files import AtomicPath

FORMAT_VERSION = 1
IMAGE_METRICS = ("psnr", "psnr_moving", "ssim", "sharpness")


def metrics_of(evaluation: Evaluation, protocol: Protocol, identity: Mapping[str, Any]) -> dict[str, Any]:
    """Build the content of ``metrics.json``; ``identity`` names the model, the checkpoint and the data.

    Every metric is an object with ``mean`` (over images), ``ci95`` (bootstrap over trajectories) and ``per_step``;
    distances are metres; ``events`` are figures over bodies. Values that do not exist are null: a system without
    particles has no ``chamfer``, ``motion``, ``events``, ``penetration`` and ``long_rollout``, one that predicts at the
    resolution of the truth has no ``native``.
    """
    systems = {system: _image_summary(evaluation, protocol, system) for system in SYSTEMS}
    summary = _summarizer(evaluation, protocol)
    return {
        "format_version": FORMAT_VERSION,
        **identity,
        "protocol": {
            **protocol.as_dict(),
            "input_views": evaluation.input_views,
            "num_views": int(evaluation.images["model"]["psnr"].shape[1]),
            "num_clips": len(evaluation.clips),
            "num_trajectories": int(np.unique(evaluation.trajectory).size),
        },
        "finite": evaluation.finite,
        **systems["model"],
        "native": _native_summary(evaluation, protocol),
        "chamfer": _parts_summary(evaluation.chamfer, summary),
        "reconstruction": {name: summary(values)["mean"] for name, values in evaluation.reconstruction.items()},
        "references": {system: systems[system] for system in SYSTEMS if system != "model"},
        "motion": _motion_summary(evaluation, protocol),
        "events": events_of(evaluation.motion),
        "penetration": _parts_summary(evaluation.penetration, summary),
        "long_rollout": _long_summary(evaluation.long_rollouts),
        "seconds": {name: plain(value) for name, value in evaluation.seconds.items()},
    }


def _summarizer(evaluation: Evaluation, protocol: Protocol) -> Any:
    return lambda values: summarize(values, evaluation.trajectory, protocol.num_bootstrap)


def _image_summary(evaluation: Evaluation, protocol: Protocol, system: str) -> dict[str, Any]:
    summary, arrays = _summarizer(evaluation, protocol), evaluation.images[system]
    num_views = arrays["psnr"].shape[1]
    inputs = np.isin(np.arange(num_views), evaluation.input_views)
    result = {}
    for name in IMAGE_METRICS:
        result[name] = summary(arrays[name])
        result[name]["input_views"] = summary(arrays[name][:, inputs])["mean"]
        result[name]["other_views"] = summary(arrays[name][:, ~inputs])["mean"]
    result["psnr"]["pooled"] = pooled_psnr(arrays["mse"])
    result["psnr_moving"]["pooled"] = pooled_psnr(arrays["moving_mse"])
    return result


def _native_summary(evaluation: Evaluation, protocol: Protocol) -> dict[str, Any] | None:
    """Means at the system's own resolution, against the truth made as small."""
    if not evaluation.native:
        return None
    summary = _summarizer(evaluation, protocol)
    means = {name: summary(evaluation.native[name])["mean"] for name in IMAGE_METRICS}
    return {"resolution": evaluation.resolution, **means}


def _parts_summary(parts: Mapping[str, NDArray[np.float64]], summary: Any) -> dict[str, Any] | None:
    """Summarise the part called ``mean``; of the others only the mean counts."""
    if not parts:
        return None
    return {**summary(parts["mean"]), **{name: summary(parts[name])["mean"] for name in parts if name != "mean"}}


def _motion_summary(evaluation: Evaluation, protocol: Protocol) -> dict[str, Any] | None:
    if not evaluation.motion:
        return None
    summary = _summarizer(evaluation, protocol)
    result = {name: summary(values) for name, values in evaluation.motion.items()}
    result["size_ratio"]["min"] = plain(np.nanmin(evaluation.motion["size_ratio"], initial=np.inf))
    result["size_ratio"]["max"] = plain(np.nanmax(evaluation.motion["size_ratio"], initial=-np.inf))
    for reference in ("constant", "copy", "velocity"):
        result[f"centroid_error_over_{reference}"] = _ratio(
            evaluation.motion["centroid_error"], evaluation.motion[f"centroid_error_{reference}"]
        )
    return result


def _ratio(error: NDArray[np.float64], reference: NDArray[np.float64]) -> dict[str, Any]:
    """Ratio of the mean errors at each step (the last axis), over those objects of clips that have both."""
    both = ~np.isnan(error) & ~np.isnan(reference)
    axes = tuple(range(both.ndim - 1))
    above, below = (np.where(both, values, 0.0).sum(axes) for values in (error, reference))
    ratios = [plain(a / b) if b > 0 else None for a, b in zip(above, below, strict=True)]
    return {"per_step": ratios, "count": int(both.sum())}


def _long_summary(rollouts: Sequence[LongRollout]) -> dict[str, Any] | None:
    """Summarise over clips and objects; ``count`` says how many clips have values, for every object of theirs.

    A clip has none where its rollout is not finite, or where its particles hardly show the object.
    """
    if not rollouts:
        return None

    def values(name: str) -> NDArray[np.float64]:
        return np.hstack([np.atleast_1d(getattr(rollout, name)) for rollout in rollouts]).astype(np.float64)

    def block(decides: str, **figures: tuple[str, Callable[[NDArray[np.float64]], Any]]) -> dict[str, Any]:
        """All figures of a block speak about the same clips and objects: those whose ``decides`` is a number."""
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
    for system, values in (("model", metrics), *metrics["references"].items()):
        for name in IMAGE_METRICS:
            columns[f"{system}/{name}"] = values[name]["per_step"]
    for name in ("chamfer", "penetration"):
        if metrics[name]:
            columns[f"model/{name}"] = metrics[name]["per_step"]
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
