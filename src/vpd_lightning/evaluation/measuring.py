"""Measure predicted clips by every metric of the list."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from vpd_lightning.data.clip import Clip
from vpd_lightning.evaluation.bodies import find_bodies
from vpd_lightning.evaluation.images import as_float, moving_pixels
from vpd_lightning.evaluation.motion import body_tracks, true_points
from vpd_lightning.evaluation.prediction import Prediction
from vpd_lightning.evaluation.protocol import Protocol
from vpd_lightning.geometry.resizing import resize_images
from vpd_lightning.metrics.metric_info import MetricInfo
from vpd_lightning.metrics.registry import (
    DRAWN,
    REFERENCES,
    SOURCES,
    body_metrics,
    image_metrics,
    particle_metrics,
    still_scores,
)
from vpd_lightning.metrics.sample_metric import SampleMetric
from vpd_lightning.metrics.true_images import TrueImages

Arrays = dict[str, NDArray[np.float64]]


class ClipMetrics:
    """The metrics of an evaluation, filled clip by clip.

    ``images[source]`` judge the model and both references in its place, ``drawn[source]`` other motions that its
    renderer draws, where they are asked for, ``reconstruction`` the decoded last input frame, ``native`` the model at
    its own resolution, ``particles`` and ``bodies`` where it has particles (and where
    there is ground truth). What a system does not have is never measured.
    """

    def __init__(self) -> None:
        self.images = {source: _sample_metrics(image_metrics()) for source in SOURCES}
        self.drawn = {source: _sample_metrics(image_metrics()) for source in DRAWN}
        self.reconstruction = _sample_metrics(still_scores())
        self.native = _sample_metrics(image_metrics())
        self.particles = _sample_metrics(particle_metrics())
        self.bodies = _sample_metrics(body_metrics())

    def update(
        self,
        number: int,
        clip: Clip,
        prediction: Prediction,
        protocol: Protocol,
        mean_image: Float[Tensor, "view height width 3"],
        constants: Float[Tensor, "step object 3"] | None,
        drawn: Mapping[str, Float[Tensor, "step_or_1 view height width 3"]],
    ) -> None:
        """Compare a prediction, and the references in its place, with the truth of clip ``number``."""
        moving = moving_pixels(clip, protocol)
        last_input = as_float(clip.rgb[-1:])
        kept = last_input if _same_cameras(clip) else None
        threshold = protocol.moving_threshold
        truth = TrueImages(as_float(clip.target_rgb), moving, protocol.min_moving_pixels, kept, threshold)
        # Both references are one image per view: what does not depend on the step is computed once.
        stand_ins = dict(zip(REFERENCES, (last_input, mean_image[None]), strict=True))
        for source, pred in {"model": prediction.images, **stand_ins}.items():
            _update(self.images[source], number, pred.nan_to_num(0.0), truth)
        for source, pred in drawn.items():
            _update(self.drawn[source], number, pred.nan_to_num(0.0), truth)
        decoded = prediction.reconstruction.nan_to_num(0.0)[None]
        _update(self.reconstruction, number, decoded, TrueImages(last_input))
        if prediction.native is not None and prediction.native.shape == prediction.images.shape:
            self.native = self.images["model"]
        elif prediction.native is not None:
            _update(self.native, number, *_native(prediction.native, clip, moving, protocol))
        if prediction.positions is None:
            return
        positions = prediction.positions
        points = [true_points(clip, step, protocol.num_chamfer_points) for step in range(positions.shape[0] - 1)]
        _update(self.particles, number, positions[1:], points)
        if clip.state is not None:
            bodies = find_bodies(clip, positions[0], protocol.body_margin, positions.shape[0] - 1)
            _update(self.bodies, number, body_tracks(clip, bodies, positions, constants))

    def image_arrays(self, source: str, num_clips: int) -> Arrays:
        """Every part of the metrics of images, axes ``clip view step``."""
        return _image_arrays(self.images[source], num_clips)

    def drawn_arrays(self, num_clips: int) -> dict[str, Arrays]:
        """The same for each motion that the renderer drew of every clip."""
        found = {source: _image_arrays(metrics, num_clips) for source, metrics in self.drawn.items()}
        return {source: arrays for source, arrays in found.items() if arrays}

    def native_arrays(self, num_clips: int) -> Arrays:
        """The same at the model's own resolution; empty where it has none."""
        return _image_arrays(self.native, num_clips)

    def reconstruction_arrays(self, num_clips: int) -> Arrays:
        """Scores of the decoded last input frame, axes ``clip view 1``."""
        arrays = _image_arrays(self.reconstruction, num_clips)
        return {name: arrays[name] for name in self.reconstruction}

    def motion_arrays(self, num_clips: int) -> Arrays:
        """What is measured of bodies, axes ``clip object step``."""
        return {
            name: arrays[metric.info.part_names[0]]
            for name, metric in self.bodies.items()
            if not metric.info.has_block and (arrays := stacked(metric, num_clips))
        }

    def block_arrays(self, num_clips: int) -> dict[str, Arrays]:
        """The metrics that stand by themselves, by part; axes ``clip step`` or ``clip object step``."""
        metrics = {**self.particles, **self.bodies}
        return {name: stacked(metric, num_clips) for name, metric in metrics.items() if metric.info.has_block}


def stacked(metric: SampleMetric, num_clips: int) -> Arrays:
    """Stack the values of all clips by part; empty unless every clip has them, in one shape.

    Ground truth may be missing from some recordings, and their numbers of bodies may differ.
    """
    clips = list(metric.by_sample().values())
    shapes = {part.shape for parts in clips for part in parts.values()}
    if len(clips) < num_clips or len(shapes) != 1:
        return {}
    names = metric.info.part_names
    return {name: np.stack([parts[name].double().cpu().numpy() for parts in clips]) for name in names}


def _sample_metrics(infos: Sequence[MetricInfo]) -> dict[str, SampleMetric]:
    return {info.name: SampleMetric(info) for info in infos}


def _update(metrics: dict[str, SampleMetric], number: int, *inputs: object) -> None:
    for metric in metrics.values():
        metric.update(number, *inputs)


def _image_arrays(metrics: dict[str, SampleMetric], num_clips: int) -> Arrays:
    parts = [stacked(metric, num_clips) for metric in metrics.values()]
    return {name: np.ascontiguousarray(values.swapaxes(1, 2)) for part in parts for name, values in part.items()}


def _same_cameras(clip: Clip) -> bool:
    """Whether all cameras stand still from the last input frame on."""
    pairs = (
        (getattr(clip.cameras, name), getattr(clip.target_cameras, name)) for name in ("cam_to_world", "intrinsics")
    )
    return all(bool((later == before[-1:]).all()) for before, later in pairs)


def _native(
    native: Float[Tensor, "step view resolution resolution 3"], clip: Clip, moving: Tensor, protocol: Protocol
) -> tuple[Tensor, TrueImages]:
    """Bring the truth to the model's own resolution; a pixel moves by majority."""
    resolution = native.shape[-3]
    colors = resize_images(as_float(clip.target_rgb), resolution)
    share = resize_images(moving[..., None].expand(*moving.shape, 3).float(), resolution)[..., 0]
    scale = (resolution / moving.shape[-2]) * (resolution / moving.shape[-1])
    min_pixels = max(1, round(protocol.min_moving_pixels * scale))
    last_input = resize_images(as_float(clip.rgb[-1:]), resolution) if _same_cameras(clip) else None
    truth = TrueImages(colors, torch.ge(share, 0.5), min_pixels, last_input, protocol.moving_threshold)
    return native.nan_to_num(0.0), truth
