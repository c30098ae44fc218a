"""Predict one held-out clip and measure it."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol as StructuralType
from typing import runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from vpd_lightning.errors import ConfigError
from vpd_lightning.evaluation.images import as_float, image_metrics, moving_pixels
from vpd_lightning.evaluation.motion import chamfer_to_depth, clip_motion, trajectory_of
from vpd_lightning.evaluation.protocol import Clip, Protocol
from vpd_lightning.simulator import Scene
from vpd_lightning.types import Cameras, Particles

SYSTEMS = ("model", "copy_last", "train_mean")


@runtime_checkable
class PredictsVideo(StructuralType):
    """What is evaluated: anything with the simulator's Python face."""

    def encode(self, rgb: Tensor, depth: Tensor, cameras: Cameras) -> Scene: ...
    def rollout(self, scene: Scene, num_steps: int) -> list[Particles]: ...
    def render(self, states: Sequence[Particles], cameras: Cameras) -> Tensor: ...


@dataclass(frozen=True)
class Prediction:
    """A predicted clip. ``images`` are float colours in [0, 1], ``reconstruction`` the rendered last input frame."""

    images: Float[Tensor, "step view height width 3"]
    reconstruction: Float[Tensor, "view height width 3"]
    positions: Float[Tensor, "time particle 3"]
    seconds: dict[str, float]

    @property
    def finite(self) -> bool:
        """Whether every predicted colour and position is a number."""
        return bool(torch.isfinite(self.images).all() and torch.isfinite(self.positions).all())

    def images_uint8(self) -> NDArray[np.uint8]:
        """The predicted images as a screen shows them (what is not a number is black)."""
        return _uint8(self.images)

    def reconstruction_uint8(self) -> NDArray[np.uint8]:
        """The rendered last input frame as a screen shows it."""
        return _uint8(self.reconstruction)


@dataclass(frozen=True)
class ClipResult:
    """What was measured: ``images[system][metric]`` (view, step), ``reconstruction[metric]`` (view, 1).

    ``chamfer[part]`` has the axis step; ``motion[metric]`` has axes (object, step) and is empty without ground truth.
    """

    images: dict[str, dict[str, NDArray[np.float64]]]
    reconstruction: dict[str, NDArray[np.float64]]
    chamfer: dict[str, NDArray[np.float64]]
    motion: dict[str, NDArray[np.float64]]


def check_views(clip: Clip, input_views: Sequence[int]) -> None:
    """Raise ``ConfigError`` where the model looks through cameras that the recording does not have."""
    num_views = clip.rgb.shape[1]
    if not input_views or max(input_views) >= num_views:
        raise ConfigError(
            f"The model reads views {list(input_views)}, but {clip.name} has {num_views} (0 to {num_views - 1}).\n"
            "Use a data set with the cameras the model was trained with."
        )


def encode_clip(simulator: PredictsVideo, clip: Clip, input_views: Sequence[int]) -> Scene:
    """Encode the context frames of a clip as the input views see them."""
    check_views(clip, input_views)
    views = list(input_views)
    return simulator.encode(clip.rgb[:, views], clip.depth[:, views], clip.cameras[:, views])


def render_steps(
    simulator: PredictsVideo, states: Sequence[Particles], cameras: Cameras
) -> Float[Tensor, "step view height width 3"]:
    """Render state ``i`` from cameras ``i`` (axes ``step view``); one call where the cameras stand still."""
    if all(bool((matrix == matrix[:1]).all()) for matrix in (cameras.cam_to_world, cameras.intrinsics)):
        return simulator.render(states, cameras[0])
    return torch.cat([simulator.render([state], cameras[step]) for step, state in enumerate(states)])


def predict_clip(simulator: PredictsVideo, clip: Clip, input_views: Sequence[int]) -> Prediction:
    """Encode, roll out and render one clip: full images of all cameras, without gradients, one state at a time."""
    ticks = [_now()]
    scene = encode_clip(simulator, clip, input_views)
    ticks.append(_now())
    states = simulator.rollout(scene, clip.target_rgb.shape[0])
    ticks.append(_now())
    images = render_steps(simulator, states, clip.target_cameras).float().cpu()
    ticks.append(_now())
    reconstruction = simulator.render([scene.current], clip.cameras[1])[0].float().cpu()
    parts = ("encode", "rollout", "render")
    seconds = {name: end - start for name, start, end in zip(parts, ticks[:-1], ticks[1:], strict=True)}
    return Prediction(images, reconstruction, trajectory_of(scene.current, states), seconds)


def measure_clip(
    clip: Clip,
    prediction: Prediction,
    protocol: Protocol,
    mean_image: Float[Tensor, "view height width 3"],
    constants: Float[Tensor, "step object 3"] | None,
) -> ClipResult:
    """Compare a prediction, and both references in its place, with the truth."""
    target = as_float(clip.target_rgb)
    moving = moving_pixels(clip, protocol)
    systems = {
        "model": prediction.images.nan_to_num(0.0),
        "copy_last": as_float(clip.rgb[-1]).expand_as(target),
        "train_mean": mean_image.expand_as(target),
    }
    images = {
        name: _numpy(image_metrics(pred, target, moving, protocol.min_moving_pixels)) for name, pred in systems.items()
    }
    last_input = as_float(clip.rgb[-1:])
    reconstruction = image_metrics(
        prediction.reconstruction.nan_to_num(0.0)[None],
        last_input,
        torch.ones_like(last_input[..., 0], dtype=torch.bool),
        protocol.min_moving_pixels,
    )
    distances = [
        chamfer_to_depth(clip, step, positions, protocol.num_chamfer_points)
        for step, positions in enumerate(prediction.positions[1:])
    ]
    chamfer = {
        "mean": np.array([distance.mean for distance in distances]),
        "accuracy": np.array([distance.accuracy for distance in distances]),
        "completeness": np.array([distance.completeness for distance in distances]),
    }
    motion = {}
    if clip.state is not None:
        motion = _numpy(clip_motion(clip, prediction.positions, protocol.body_margin, constants)[0])
    return ClipResult(images, {name: _numpy(reconstruction)[name] for name in ("psnr", "ssim")}, chamfer, motion)


def _uint8(colors: Tensor) -> NDArray[np.uint8]:
    return (colors.nan_to_num(0.0).clamp(0, 1) * 255).round().to(torch.uint8).numpy()


def _numpy(values: dict[str, Tensor]) -> dict[str, NDArray[np.float64]]:
    return {name: value.double().numpy() for name, value in values.items()}


def _now() -> float:
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return time.perf_counter()
