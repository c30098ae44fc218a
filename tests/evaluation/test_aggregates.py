"""From single values to printed means: every mean can be recomputed from the saved arrays, and none has moved."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.evaluation.conftest import protocol_with
from tests.evaluation.tossed_box import Swaying
from vpd_lightning.data.manifest import Manifest
from vpd_lightning.evaluation.evaluate import Evaluation, evaluate
from vpd_lightning.evaluation.protocol import Protocol
from vpd_lightning.evaluation.report import metrics_of, write_metrics
from vpd_lightning.evaluation.statistics import summarize

# Computed by the code as it was when everything was rigid and SSIM came from torchmetrics (whose float32 is good to
# 1e-5): what a trained model was given must not change without saying so.
KNOWN = {
    "psnr": 27.12683896223704,
    "ssim": 0.9893810686965784,
    "psnr_moving": 25.430700937906902,
    "chamfer": 0.05074243738112838,
    "references/copy_last/psnr": 21.969871679941814,
    "references/copy_last/ssim": 0.6793714109808207,
    "references/copy_last/psnr_moving": 12.10275516907374,
    "references/train_mean/psnr": 21.17360273996989,
    "references/train_mean/ssim": 0.5696679465472698,
    "references/train_mean/psnr_moving": 11.466728925704956,
    "motion/centroid_error": 0.017904242445768825,
    "motion/particle_error": 0.02554237899758727,
    "motion/rigidity_error": 0.014834158363965311,
    "motion/size_ratio": 1.0385393594021315,
    "motion/lowest_point": -0.21904585024785547,
    "motion/centroid_error_constant": 0.0894868785715444,
    "motion/centroid_error_copy": 0.13617360188911534,
    "motion/particle_error_copy": 0.14981633186895882,
    "long_rollout/floor_drift": 0.058387538181747856,
    "long_rollout/size_ratio": 1.050254103952663,
    "long_rollout/lowest_point": -0.36564090400990573,
    "long_rollout/final_speed": 0.0641278341917203,
    "long_rollout/centroid_error": 0.01783450850973188,
}


@pytest.fixture(scope="module")
def protocol() -> Protocol:
    return protocol_with(num_long_steps=6)


@pytest.fixture(scope="module")
def evaluation(manifest: Manifest, protocol: Protocol) -> Evaluation:
    return evaluate(Swaying(manifest.split("test")), manifest, protocol, [0])


@pytest.mark.parametrize("name", KNOWN)
def test_a_rigid_scene_keeps_its_figures(evaluation: Evaluation, protocol: Protocol, name: str) -> None:
    block: Any = metrics_of(evaluation, protocol, {})
    for key in name.split("/"):
        block = block[key]
    value = block["median"] if name.startswith("long_rollout") else block["mean"]
    assert value == pytest.approx(KNOWN[name], rel=5e-5 if name.endswith("ssim") else 1e-6)


def summaries(block: Mapping[str, Any], place: str = "") -> Iterator[tuple[str, Mapping[str, Any]]]:
    """All objects with a mean and a curve, by their place in metrics.json."""
    if "per_step" in block and "mean" in block:
        yield place, block
    for key, value in block.items():
        if isinstance(value, Mapping):
            yield from summaries(value, f"{place}/{key}" if place else key)


def array_of(place: str) -> str:
    """The name in arrays.npz of what a place in metrics.json summarises."""
    for start, name in (("references/", ""), ("motion/", "motion/")):
        if place.startswith(start):
            return name + place.removeprefix(start)
    return f"{place}/mean" if place in ("chamfer", "penetration") else f"model/{place}"


def test_saved_arrays_reproduce_every_mean(evaluation: Evaluation, protocol: Protocol, tmp_path: Path) -> None:
    metrics = metrics_of(evaluation, protocol, {})
    write_metrics(tmp_path, metrics, evaluation)
    arrays = np.load(tmp_path / "arrays.npz", allow_pickle=False)
    found = dict(summaries(metrics))
    assert {"psnr", "ssim", "psnr_moving", "sharpness", "chamfer", "penetration"} <= set(found) and len(found) >= 20
    for place, block in found.items():
        values = arrays[array_of(place)]
        if block["mean"] is None:
            assert np.isnan(values).all(), place
            continue
        assert block["mean"] == pytest.approx(np.nanmean(values)), place
        curve = np.nanmean(values.reshape(-1, values.shape[-1]), axis=0)
        assert block["per_step"] == pytest.approx(curve.tolist()), place
        if not np.isnan(values).any():
            assert block["mean"] == pytest.approx(np.mean(block["per_step"])), "the curve's mean is the headline"
        for part in ("accuracy", "completeness", "floor", "true_motion"):
            if part in block:
                assert block[part] == pytest.approx(np.nanmean(arrays[f"{place}/{part}"]))
        for part, views in (("input_views", [0]), ("other_views", [1])):
            if part in block:
                assert block[part] == pytest.approx(np.nanmean(values[:, views]))
    for name, value in metrics["reconstruction"].items():
        measured = arrays[f"reconstruction/{name}"]
        assert np.isnan(measured).all() if value is None else value == pytest.approx(measured.mean()), name


def test_a_clip_counts_the_same_in_any_company(manifest: Manifest, evaluation: Evaluation) -> None:
    for changes, rows in (({"num_trajectories": 1}, slice(0, 2)), ({"start_frames": (2,)}, slice(1, None, 2))):
        alone = evaluate(Swaying(manifest.split("test")), manifest, protocol_with(num_long_steps=0, **changes), [0])
        assert alone.clips == evaluation.clips[rows]
        for name, values in alone.images["model"].items():
            assert np.array_equal(values, evaluation.images["model"][name][rows], equal_nan=True), name
        for name, values in alone.blocks["penetration"].items():
            assert np.array_equal(values, evaluation.blocks["penetration"][name][rows], equal_nan=True), name


def test_trajectories_with_more_clips_weigh_more_in_the_mean_and_the_same_in_the_bootstrap() -> None:
    values = np.array([1.0, 1.0, 1.0, 5.0])[:, None]
    summary = summarize(values, np.array([0, 0, 0, 1]), num_bootstrap=500)
    assert summary["mean"] == pytest.approx(2.0) and summary["count"] == 4
    assert summary["ci95"] == pytest.approx([1.0, 5.0])
    assert summary["std_trajectories"] == pytest.approx(np.std([1.0, 5.0], ddof=1))
