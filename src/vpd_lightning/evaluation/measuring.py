"""Measure one predicted clip."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from vpd_lightning.data.clip import Clip
from vpd_lightning.evaluation.bodies import find_bodies
from vpd_lightning.evaluation.images import TrueImages, as_float, image_metrics, moving_pixels
from vpd_lightning.evaluation.motion import MIN_BODY_PARTICLES, bodies_motion, chamfer_to_depth
from vpd_lightning.evaluation.penetration import clip_penetration
from vpd_lightning.evaluation.prediction import Prediction
from vpd_lightning.evaluation.protocol import Protocol
from vpd_lightning.geometry.resizing import resize_images

SYSTEMS = ("model", "copy_last", "train_mean")
Arrays = dict[str, NDArray[np.float64]]


@dataclass(frozen=True)
class ClipResult:
    """What was measured: ``images[system][metric]`` (view, step), ``reconstruction[metric]`` (view, 1).

    ``native[metric]`` (view, step) judges the model at its own resolution, ``chamfer[part]`` has the axis step, and
    ``motion[metric]`` and ``penetration[part]`` have axes (object, step). They are empty for what a system does not
    have (a resolution of its own, particles) and where there is no ground truth.
    """

    images: dict[str, Arrays]
    reconstruction: Arrays
    native: Arrays
    chamfer: Arrays
    motion: Arrays
    penetration: Arrays


def measure_clip(
    clip: Clip,
    prediction: Prediction,
    protocol: Protocol,
    mean_image: Float[Tensor, "view height width 3"],
    constants: Float[Tensor, "step object 3"] | None,
) -> ClipResult:
    """Compare a prediction, and both references in its place, with the truth."""
    colors = as_float(clip.target_rgb)
    moving = moving_pixels(clip, protocol)
    target = TrueImages.of(colors, moving, protocol.min_moving_pixels)
    last_input = as_float(clip.rgb[-1:])
    # Both references are one image per view: what does not depend on the step is computed once.
    systems = {"model": prediction.images, "copy_last": last_input, "train_mean": mean_image[None]}
    images = {name: _numpy(image_metrics(pred.nan_to_num(0.0), target)) for name, pred in systems.items()}
    everywhere = torch.ones_like(last_input[..., 0], dtype=torch.bool)
    seen = TrueImages.of(last_input, everywhere, protocol.min_moving_pixels)
    reconstruction = _numpy(image_metrics(prediction.reconstruction.nan_to_num(0.0)[None], seen))
    return ClipResult(
        images=images,
        reconstruction={name: reconstruction[name] for name in ("psnr", "ssim")},
        native=_native(prediction, clip, moving, protocol, images["model"]),
        chamfer=_chamfer(clip, prediction, protocol),
        **_bodies(clip, prediction, protocol, constants),
    )


def _native(prediction: Prediction, clip: Clip, moving: Tensor, protocol: Protocol, enlarged: Arrays) -> Arrays:
    """Judge a model at its own resolution, against the truth made as small; a pixel moves by majority."""
    if prediction.native is None:
        return {}
    if prediction.native.shape == prediction.images.shape:
        return enlarged
    resolution = prediction.native.shape[-3]
    colors = resize_images(as_float(clip.target_rgb), resolution)
    share = resize_images(moving[..., None].expand(*moving.shape, 3).float(), resolution)[..., 0]
    scale = (resolution / moving.shape[-2]) * (resolution / moving.shape[-1])
    min_pixels = max(1, round(protocol.min_moving_pixels * scale))
    return _numpy(image_metrics(prediction.native.nan_to_num(0.0), TrueImages.of(colors, share >= 0.5, min_pixels)))


def _chamfer(clip: Clip, prediction: Prediction, protocol: Protocol) -> Arrays:
    if prediction.positions is None:
        return {}
    distances = [
        chamfer_to_depth(clip, step, positions, protocol.num_chamfer_points)
        for step, positions in enumerate(prediction.positions[1:])
    ]
    parts = ("mean", "accuracy", "completeness")
    return {part: np.array([getattr(distance, part) for distance in distances]) for part in parts}


def _bodies(
    clip: Clip, prediction: Prediction, protocol: Protocol, constants: Float[Tensor, "step object 3"] | None
) -> dict[str, Arrays]:
    positions = prediction.positions
    if clip.state is None or positions is None:
        return {"motion": {}, "penetration": {}}
    bodies = find_bodies(clip, positions[0], protocol.body_margin, positions.shape[0] - 1)
    return {
        "motion": _numpy(bodies_motion(bodies, positions, constants, clip.frame_time)),
        "penetration": _numpy(clip_penetration(clip, bodies, positions, MIN_BODY_PARTICLES)),
    }


def _numpy(values: dict[str, Tensor]) -> Arrays:
    return {name: value.double().numpy() for name, value in values.items()}
