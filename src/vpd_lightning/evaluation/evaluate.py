"""Run the protocol over a held-out split."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vpd_lightning.data.manifest import Manifest
from vpd_lightning.errors import DataError
from vpd_lightning.evaluation.clip import (
    SYSTEMS,
    Prediction,
    PredictsVideo,
    encode_clip,
    measure_clip,
    predict_clip,
)
from vpd_lightning.evaluation.long_rollout import LongRollout, judge_long_rollout
from vpd_lightning.evaluation.motion import clip_motion, trajectory_of
from vpd_lightning.evaluation.protocol import Clip, Protocol, read_clip, read_clips
from vpd_lightning.evaluation.references import median_displacements, training_mean

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Evaluation:
    """Everything measured; the first axis of every array counts clips, ``trajectory`` says whose clip each one is.

    ``images[system][metric]`` is [clip, view, step], ``reconstruction[metric]`` [clip, view, 1], ``chamfer[part]``
    [clip, step], ``motion[metric]`` [clip, object, step] (empty without ground truth). ``kept`` are the first clips
    with their predictions, for pictures and videos.
    """

    clips: list[str]
    trajectory: NDArray[np.int64]
    input_views: list[int]
    images: dict[str, dict[str, NDArray[np.float64]]]
    reconstruction: dict[str, NDArray[np.float64]]
    chamfer: dict[str, NDArray[np.float64]]
    motion: dict[str, NDArray[np.float64]]
    long_rollouts: list[LongRollout]
    seconds: dict[str, float]
    finite: bool
    kept: list[tuple[Clip, Prediction]]

    def arrays(self) -> dict[str, NDArray[Any]]:
        """All arrays under flat names, for an NPZ file."""
        groups: dict[str, dict[str, NDArray[np.float64]]] = {
            **self.images,
            "reconstruction": self.reconstruction,
            "chamfer": self.chamfer,
            "motion": self.motion,
        }
        flat = {f"{group}/{name}": values for group, metrics in groups.items() for name, values in metrics.items()}
        return {"trajectory": self.trajectory, "clip": np.array(self.clips), **flat}


def _silent(what: str, done: int, total: int) -> None:
    """Report progress to nobody."""


def evaluate(
    simulator: PredictsVideo,
    manifest: Manifest,
    protocol: Protocol,
    input_views: Sequence[int],
    num_kept: int = 0,
    progress: Progress = _silent,
) -> Evaluation:
    """Evaluate on the protocol's clips. ``progress`` hears what is being done, how much of it, and of how much.

    Raises:
        DataError: the data set lacks the split, its recordings are too short, or they differ in shape.
        ConfigError: the recordings lack the model's input views.
    """
    began = time.perf_counter()
    paths = manifest.split(protocol.split)[: protocol.num_trajectories]
    progress("references", 0, 1)
    train_paths = manifest.split("train")
    mean_image = training_mean(train_paths)
    constants = median_displacements(train_paths, protocol.start_frames, protocol.num_steps)
    num_clips = len(paths) * len(protocol.start_frames)
    names, trajectory, results, kept, timings, finite = [], [], [], [], [], True
    for number, clip in enumerate(read_clips(paths, protocol)):
        progress("clips", number, num_clips)
        if clip.rgb.shape[1:] != mean_image.shape:
            raise DataError(f"{clip.name} has images {tuple(clip.rgb.shape[1:])}, training {tuple(mean_image.shape)}.")
        prediction = predict_clip(simulator, clip, input_views)
        results.append(measure_clip(clip, prediction, protocol, mean_image, constants.get(clip.start)))
        names.append(clip.name)
        trajectory.append(clip.trajectory)
        timings.append(prediction.seconds)
        finite = finite and prediction.finite
        if number < num_kept:
            kept.append((clip, prediction))
    long_rollouts = _roll_out_long(simulator, paths, protocol, input_views, progress)
    seconds = {f"{name}_per_clip": float(np.mean([t[name] for t in timings])) for name in timings[0]}
    seconds["total"] = time.perf_counter() - began
    return Evaluation(
        clips=names,
        trajectory=np.array(trajectory),
        input_views=list(input_views),
        images={system: _stack([result.images[system] for result in results]) for system in SYSTEMS},
        reconstruction=_stack([result.reconstruction for result in results]),
        chamfer=_stack([result.chamfer for result in results]),
        motion=_stack([result.motion for result in results]),
        long_rollouts=long_rollouts,
        seconds=seconds,
        finite=finite,
        kept=kept,
    )


def _stack(rows: list[dict[str, NDArray[np.float64]]]) -> dict[str, NDArray[np.float64]]:
    """Stack the metrics that every clip has (ground truth may be missing from some recordings)."""
    names = [name for name in rows[0] if all(name in row and row[name].shape == rows[0][name].shape for row in rows)]
    return {name: np.stack([row[name] for row in rows]) for name in names}


def _roll_out_long(
    simulator: PredictsVideo, paths: Sequence[Path], protocol: Protocol, input_views: Sequence[int], progress: Progress
) -> list[LongRollout]:
    """Roll one clip of every trajectory with ground truth out to ``num_long_steps``."""
    rollouts: list[LongRollout] = []
    if protocol.num_long_steps == 0:
        return rollouts
    for number, path in enumerate(paths):
        progress("long rollouts", number, len(paths))
        clip = read_clip(path, number, protocol.long_start_frame, num_steps=1)
        if clip.state is None:
            continue
        scene = encode_clip(simulator, clip, input_views)
        positions = trajectory_of(scene.current, simulator.rollout(scene, protocol.num_long_steps))
        motion, bodies = clip_motion(clip, positions, protocol.body_margin, None)
        rollouts.append(judge_long_rollout(clip.name, number, positions, bodies, motion))
    return rollouts
