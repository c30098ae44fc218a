"""Run the protocol over a held-out split."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from vpd_lightning.data.clip import Clip, read_clip
from vpd_lightning.data.manifest import Manifest
from vpd_lightning.errors import DataError
from vpd_lightning.evaluation.drawn_references import drawn_references
from vpd_lightning.evaluation.kept_mean import kept_training_mean
from vpd_lightning.evaluation.long_rollout import LongRollout, judge_long_rollout
from vpd_lightning.evaluation.measuring import Arrays, ClipMetrics
from vpd_lightning.evaluation.motion import clip_motion, trajectory_of
from vpd_lightning.evaluation.prediction import (
    Prediction,
    PredictsVideo,
    PredictsViews,
    encode_clip,
    has_particles,
    num_context_frames,
    predict_clip,
    roll_out_clip,
    views_seen,
    without_depth,
)
from vpd_lightning.evaluation.protocol import Protocol, read_clips
from vpd_lightning.evaluation.references import median_displacements
from vpd_lightning.metrics.registry import SOURCES

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Evaluation:
    """Everything measured; the first axis of every array counts clips, ``trajectory`` is the trajectory of each clip.

    ``images[system][metric]``, ``drawn[motion][metric]`` (other motions, drawn by the model's renderer) and
    ``native[metric]`` (at the system's own ``resolution``) are [clip, view, step],
    ``reconstruction[metric]`` [clip, view, 1], ``motion[metric]`` [clip, object, step], and ``blocks[metric][part]``
    [clip, step] where all particles are judged together, [clip, object, step] where bodies are. They are empty for what
    the system or the recordings do not have: a resolution of its own (None), particles, ground truth. ``kept`` are the
    first clips with their predictions, for pictures and videos, ``shown_views`` the cameras to show: one that particles
    are seen through, and one that not.
    """

    clips: list[str]
    trajectory: NDArray[np.int64]
    input_views: list[int]
    shown_views: list[int]
    resolution: int | None
    images: dict[str, Arrays]
    reconstruction: Arrays
    drawn: dict[str, Arrays]
    native: Arrays
    motion: Arrays
    blocks: dict[str, Arrays]
    long_rollouts: list[LongRollout]
    seconds: dict[str, float]
    finite: bool
    kept: list[tuple[Clip, Prediction]]

    def arrays(self) -> dict[str, NDArray[Any]]:
        """All arrays under flat names, for an NPZ file."""
        groups: dict[str, Arrays] = {
            **self.images,
            **self.drawn,
            "reconstruction": self.reconstruction,
            "native": self.native,
            "motion": self.motion,
            **self.blocks,
        }
        flat = {f"{group}/{name}": values for group, arrays in groups.items() for name, values in arrays.items()}
        return {"trajectory": self.trajectory, "clip": np.array(self.clips), **flat}


def _silent(what: str, done: int, total: int) -> None:
    """Report progress to nobody."""


def evaluate(
    system: PredictsVideo | PredictsViews,
    manifest: Manifest,
    protocol: Protocol,
    input_views: Sequence[int],
    num_kept: int = 0,
    progress: Progress = _silent,
    *,
    hide_depth: bool = False,
) -> Evaluation:
    """Evaluate on the protocol's clips. ``progress`` receives the task's name, how much is done, and of how much.

    ``hide_depth`` shows the system no depth (it is not measured anywhere), for systems that predict it.

    Raises:
        DataError: the data set lacks the split, its recordings are too short, or they differ in shape.
        ConfigError: the recordings lack the model's input views, or frames before the protocol's start frames.
    """
    began = time.perf_counter()
    paths = manifest.split(protocol.split)[: protocol.num_trajectories]
    progress("references", 0, 1)
    train_paths = manifest.split("train")
    mean_image = kept_training_mean(manifest)
    constants = median_displacements(train_paths, protocol.start_frames, protocol.num_steps)
    watch = {"references": time.perf_counter() - began, "read": 0.0, "measure": 0.0}
    num_clips = len(paths) * len(protocol.start_frames)
    names, trajectory, kept, timings, finite = [], [], [], [], True
    metrics, resolution = ClipMetrics(), None
    tick = time.perf_counter()
    for number, clip in enumerate(read_clips(paths, protocol, num_context_frames(system))):
        watch["read"] += time.perf_counter() - tick
        progress("clips", number, num_clips)
        if clip.rgb.shape[1:] != mean_image.shape:
            raise DataError(f"{clip.name} has images {tuple(clip.rgb.shape[1:])}, training {tuple(mean_image.shape)}.")
        shown = without_depth(clip) if hide_depth else clip
        prediction = predict_clip(system, shown, input_views)
        drawn: Mapping[str, Tensor] = {}
        tick = time.perf_counter()
        is_known = prediction.positions is not None and clip.state is not None
        if protocol.draw_references and is_known and isinstance(system, PredictsVideo):
            drawn = drawn_references(system, encode_clip(system, shown, input_views), clip, protocol.body_margin)
            watch["draw"] = watch.get("draw", 0.0) + time.perf_counter() - tick
        tick = time.perf_counter()
        metrics.update(number, clip, prediction, protocol, mean_image, constants.get(clip.start), drawn)
        names.append(clip.name)
        trajectory.append(clip.trajectory)
        timings.append(prediction.seconds)
        finite = finite and prediction.finite
        if number < num_kept:
            kept.append((clip, prediction))
        resolution = None if prediction.native is None else prediction.native.shape[-3]
        watch["measure"] += time.perf_counter() - tick
        tick = time.perf_counter()
    long_rollouts = []
    if isinstance(system, PredictsVideo):
        long_rollouts = _roll_out_long(system, paths, protocol, input_views, progress, hide_depth)
    num_views = mean_image.shape[0]
    return Evaluation(
        clips=names,
        trajectory=np.array(trajectory),
        input_views=views_seen(system, input_views, num_views),
        shown_views=_shown_views(list(input_views), num_views),
        resolution=resolution,
        images={source: metrics.image_arrays(source, num_clips) for source in SOURCES},
        reconstruction=metrics.reconstruction_arrays(num_clips),
        drawn=metrics.drawn_arrays(num_clips),
        native=metrics.native_arrays(num_clips),
        motion=metrics.motion_arrays(num_clips),
        blocks=metrics.block_arrays(num_clips),
        long_rollouts=long_rollouts,
        seconds={
            **{f"{name}_per_clip": float(np.mean([t[name] for t in timings])) for name in timings[0]},
            **watch,
            "total": time.perf_counter() - began,
        },
        finite=finite,
        kept=kept,
    )


def _shown_views(input_views: list[int], num_views: int) -> list[int]:
    """Two cameras: the first input camera, and the first that is no input (or, if all are, the second)."""
    known = [view for view in input_views if view < num_views]
    others = [view for view in range(num_views) if view not in known]
    return [*known[:1], *(others or known[1:])[:1]]


def _roll_out_long(
    simulator: PredictsVideo,
    paths: Sequence[Path],
    protocol: Protocol,
    input_views: Sequence[int],
    progress: Progress,
    hide_depth: bool,
) -> list[LongRollout]:
    """Roll one clip of every trajectory with ground truth out to ``num_long_steps``; none without particles."""
    rollouts: list[LongRollout] = []
    if protocol.num_long_steps == 0:
        return rollouts
    for number, path in enumerate(paths):
        progress("long rollouts", number, len(paths))
        clip = read_clip(path, number, protocol.long_start_frame, num_steps=1)
        if clip.state is None:
            continue
        scene = encode_clip(simulator, without_depth(clip) if hide_depth else clip, input_views)
        if not has_particles(scene):
            break
        positions = trajectory_of(scene.current, roll_out_clip(simulator, scene, clip, protocol.num_long_steps))
        motion, bodies = clip_motion(clip, positions, protocol.body_margin, None)
        rollouts.append(judge_long_rollout(clip.name, number, positions, bodies, motion))
    return rollouts
