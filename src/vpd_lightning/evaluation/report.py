"""What an evaluation says: ``metrics.json``, ``metrics.csv``, ``arrays.npz`` and a compact table."""

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vpd_lightning.data.schema import AtomicPath
from vpd_lightning.evaluation.clip import SYSTEMS
from vpd_lightning.evaluation.evaluate import Evaluation
from vpd_lightning.evaluation.long_rollout import LongRollout
from vpd_lightning.evaluation.protocol import Protocol
from vpd_lightning.evaluation.statistics import plain, pooled_psnr, summarize

FORMAT_VERSION = 1


def metrics_of(evaluation: Evaluation, protocol: Protocol, identity: Mapping[str, Any]) -> dict[str, Any]:
    """Build the content of ``metrics.json``; ``identity`` names the model, the checkpoint and the data.

    Every metric is an object with ``mean`` (over images), ``ci95`` (bootstrap over trajectories) and ``per_step``;
    distances are metres. Values that do not exist are null.
    """
    systems = {system: _image_summary(evaluation, protocol, system) for system in SYSTEMS}
    summary = _summarizer(evaluation, protocol)
    chamfer = summary(evaluation.chamfer["mean"])
    for part in ("accuracy", "completeness"):
        chamfer[part] = summary(evaluation.chamfer[part])["mean"]
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
        "chamfer": chamfer,
        "reconstruction": {name: summary(values)["mean"] for name, values in evaluation.reconstruction.items()},
        "references": {system: systems[system] for system in SYSTEMS if system != "model"},
        "motion": _motion_summary(evaluation, protocol),
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
    for name in ("psnr", "ssim", "psnr_moving"):
        result[name] = summary(arrays[name])
        result[name]["input_views"] = summary(arrays[name][:, inputs])["mean"]
        result[name]["other_views"] = summary(arrays[name][:, ~inputs])["mean"]
    result["psnr"]["pooled"] = pooled_psnr(arrays["mse"])
    result["psnr_moving"]["pooled"] = pooled_psnr(arrays["moving_mse"])
    return result


def _motion_summary(evaluation: Evaluation, protocol: Protocol) -> dict[str, Any] | None:
    if not evaluation.motion:
        return None
    summary = _summarizer(evaluation, protocol)
    result = {name: summary(values) for name, values in evaluation.motion.items()}
    result["size_ratio"]["min"] = plain(np.nanmin(evaluation.motion["size_ratio"], initial=np.inf))
    result["size_ratio"]["max"] = plain(np.nanmax(evaluation.motion["size_ratio"], initial=-np.inf))
    for reference in ("constant", "copy"):
        steps = zip(
            result["centroid_error"]["per_step"], result[f"centroid_error_{reference}"]["per_step"], strict=True
        )
        ratios = [None if error is None or not other else error / other for error, other in steps]
        result[f"centroid_error_over_{reference}"] = {"per_step": ratios}
    return result


def _long_summary(rollouts: Sequence[LongRollout]) -> dict[str, Any] | None:
    if not rollouts:
        return None

    def values(name: str) -> NDArray[np.float64]:
        return np.hstack([np.atleast_1d(getattr(rollout, name)) for rollout in rollouts]).astype(np.float64)

    def median(name: str) -> float | None:
        known = values(name)[~np.isnan(values(name))]
        return plain(np.median(known)) if known.size else None

    return {
        "num_steps": rollouts[0].num_steps,
        "num_clips": len(rollouts),
        "finite": all(rollout.finite for rollout in rollouts),
        "floor_drift": {
            "median": median("floor_drift_median"),
            "p99": median("floor_drift_p99"),
            "max": _extreme(values("floor_drift_max"), max),
        },
        "size_ratio": {
            "median": median("size_ratio_end"),
            "min": _extreme(values("size_ratio_min"), min),
            "max": _extreme(values("size_ratio_max"), max),
        },
        "lowest_point": {"median": median("lowest_point"), "min": _extreme(values("lowest_point"), min)},
        "final_speed": {"median": median("final_speed"), "max": _extreme(values("final_speed"), max)},
        "centroid_error": {"median": median("centroid_error"), "copy_median": median("centroid_error_copy")},
        "clips": [_json_ready(asdict(rollout)) for rollout in rollouts],
    }


def _extreme(values: NDArray[np.float64], pick: Any) -> float | None:
    known = values[~np.isnan(values)]
    return plain(pick(known)) if known.size else None


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
        for name in ("psnr", "psnr_moving", "ssim"):
            columns[f"{system}/{name}"] = values[name]["per_step"]
    columns["model/chamfer"] = metrics["chamfer"]["per_step"]
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
