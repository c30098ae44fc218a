"""Run folders with known numbers, as vpd-train and vpd-eval leave them."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from vpd_lightning.evaluation.statistics import summarize

NUM_TRAJECTORIES, NUM_VIEWS, NUM_STEPS, SIDE = 6, 2, 4, 16
NUM_BOOTSTRAP = 200
MakeRun = Callable[..., Path]


def difficulty() -> NDArray[np.float64]:
    """What makes a trajectory hard for every system (dB), [clip, view, step]."""
    rng = np.random.default_rng(3)
    of_clip = rng.normal(0.0, 2.0, NUM_TRAJECTORIES)[:, None, None]
    return np.broadcast_to(of_clip - 0.5 * np.arange(NUM_STEPS), (NUM_TRAJECTORIES, NUM_VIEWS, NUM_STEPS)).copy()


def write_run(
    folder: Path,
    system: str = "vpd",
    seed: int = 0,
    psnr: float = 30.0,
    experiment: str = "mujoco_block",
    data_sha256: str = "a" * 64,
    has_particles: bool = True,
    minutes: float | None = 60.0,
    num_trajectories: int | None = 256,
    settings: dict[str, Any] | None = None,
    protocol: dict[str, Any] | None = None,
    evaluation: str = "evaluation",
    first_clip: int = 0,
) -> Path:
    """Write a run whose PSNR is ``psnr`` plus what every clip and step does to all systems; returns its folder."""
    rng = np.random.default_rng(seed + 10)
    trajectory = np.arange(NUM_TRAJECTORIES)
    shape = (NUM_TRAJECTORIES, NUM_VIEWS, NUM_STEPS)
    images = {
        "model": psnr + difficulty() + rng.normal(0.0, 0.01, shape),
        "copy_last": 20.0 + difficulty(),
        "train_mean": 22.0 + difficulty(),
    }
    arrays: dict[str, NDArray[Any]] = {
        "trajectory": trajectory,
        "clip": np.array([f"test/{first_clip + i:06d}.h5@4" for i in trajectory]),
    }
    content: dict[str, Any] = {}
    for source, values in images.items():
        scores = {"psnr": values, "psnr_moving": values - 8.0, "ssim": values / 40.0, "sharpness": values / 35.0}
        scores["psnr_moving"][0, 0, 0] = np.nan  # an image in which hardly anything moves
        arrays |= {f"{source}/{name}": score for name, score in scores.items()}
        content[source] = {name: summarize(score, trajectory, NUM_BOOTSTRAP) for name, score in scores.items()}
    motion = {}
    if has_particles:
        error = np.full((NUM_TRAJECTORIES, 1, NUM_STEPS), 0.05) * (1 + np.arange(NUM_TRAJECTORIES))[:, None, None] / 6
        arrays |= {"motion/centroid_error": error, "motion/rigidity_error": error / 10, "chamfer/mean": error[:, 0]}
        arrays["motion/centroid_error_copy"] = error * (1 + np.arange(NUM_STEPS))
        names = ("centroid_error", "centroid_error_copy", "rigidity_error")
        motion = {n: summarize(arrays[f"motion/{n}"], trajectory, NUM_BOOTSTRAP) for n in names}
    metrics = {
        "format_version": 1, "model": experiment, "system": system, "experiment": experiment, "seed": seed,
        "checkpoint_sha256": "c" * 64, "step": 500, "data": str(folder / "no_data"), "data_sha256": data_sha256,
        "seen_in_training": {"trajectories": 0, "of": NUM_TRAJECTORIES},
        "num_parameters": 12345, "finite": True, **content["model"],
        "protocol": {
            "split": "test", "start_frames": [4], "num_steps": NUM_STEPS, "num_views": NUM_VIEWS, "input_views": [0],
            "num_clips": NUM_TRAJECTORIES, "num_trajectories": NUM_TRAJECTORIES, "num_bootstrap": NUM_BOOTSTRAP,
            **(protocol or {}),
        },
        "references": {source: content[source] for source in ("copy_last", "train_mean")},
        "chamfer": summarize(arrays["chamfer/mean"], trajectory, NUM_BOOTSTRAP) if has_particles else None,
        "motion": motion or None,
        "native": None,
        "seconds": {"encode_per_clip": 0.04, "rollout_per_clip": 0.1, "render_per_clip": 0.02 * psnr, "total": 1.0},
    }  # fmt: skip
    config = {
        "experiment": experiment, "system": system, "seed": seed, "sweep_name": None,
        "run": {"folder": str(folder)},
        "data": {"seed": seed, "num_trajectories": num_trajectories, "input_views": [0],
                 "folder": str(folder / "no_data")},
        "scene": {"input_views": [0], "location_noise": 0.0},
        "renderer": {"_target_": "vpd_lightning.renderer.splat.SplatRenderer", "num_layers": 3},
        "trainer": {"max_steps": 500, "default_root_dir": str(folder)},
        "callbacks": {"time_budget": {"minutes": minutes, "clock": "cpu"} if minutes else None},
    }  # fmt: skip
    for key, value in (settings or {}).items():
        section, _, name = key.rpartition(".")
        (config[section] if section else config)[name] = value
    out = folder / evaluation
    out.mkdir(parents=True)
    (folder / "config.yaml").write_text(yaml.safe_dump(config, sort_keys=False))
    (out / "metrics.json").write_text(json.dumps(metrics))
    np.savez_compressed(out / "arrays.npz", **arrays)
    time = {"seconds": 60.0 * (minutes or 5.0), "clock": "cpu", "steps": 500, "pretraining": None}
    (folder / "training_time.json").write_text(json.dumps(time))
    return folder


def write_rollouts(run: Path, shade: int, clips: tuple[str, ...] = ("test/000000.h5@4",), side: int = SIDE) -> None:
    """Write ``rollouts.npz``: a gradient as the truth, a plain grey as the prediction, of two cameras."""
    ramp = np.broadcast_to(np.linspace(0, 255, SIDE).astype(np.uint8)[:, None], (SIDE, SIDE, 3))
    lead = (len(clips), NUM_STEPS, 2)
    np.savez_compressed(
        run / "evaluation" / "rollouts.npz",
        clips=np.array(clips),
        views=np.array([0, 3]),
        context=np.broadcast_to(ramp, (len(clips), 2, 2, SIDE, SIDE, 3)),
        truth=np.broadcast_to(ramp, (*lead, SIDE, SIDE, 3)),
        prediction=np.full((*lead, side, side, 3), shade, np.uint8),
    )
