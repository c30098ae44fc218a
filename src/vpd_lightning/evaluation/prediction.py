"""Predict one held-out clip."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol as StructuralType
from typing import runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy.typing import NDArray
from torch import Tensor

from vpd_lightning.data.clip import Clip, read_motion
from vpd_lightning.errors import ConfigError
from vpd_lightning.evaluation.motion import trajectory_of
from vpd_lightning.geometry.resizing import resize_images
from vpd_lightning.simulator import Scene
from vpd_lightning.types import NUM_CONTEXT_FRAMES, Cameras, Driven, Particles


@runtime_checkable
class PredictsVideo(StructuralType):
    """A system of particles: anything with the simulator's Python interface."""

    def encode(self, rgb: Tensor, depth: Tensor, cameras: Cameras) -> Scene: ...
    def rollout(self, scene: Scene, num_steps: int) -> list[Particles]: ...
    def render(self, states: Sequence[Particles], cameras: Cameras) -> Tensor: ...


@runtime_checkable
class PredictsViews(StructuralType):
    """A system that continues the video of each view from that view's own frames, at a resolution of its own.

    It sees the last ``num_context_frames`` frames. Images are square, colours float in [0, 1].
    """

    num_context_frames: int

    def encode_views(self, rgb: UInt8[Tensor, "time view height width 3"]) -> Float[Tensor, "view time slot dim"]: ...
    def rollout_views(
        self, slots: Float[Tensor, "view time slot dim"], num_steps: int
    ) -> Float[Tensor, "view step slot dim"]: ...
    def decode(self, slots: Float[Tensor, "*shape slot dim"]) -> Float[Tensor, "*shape resolution resolution 3"]: ...


@dataclass(frozen=True)
class Prediction:
    """A predicted clip. ``images`` are float colours in [0, 1], ``reconstruction`` the last input frame, decoded.

    ``native`` are the images at the system's own resolution where it has one, of which ``images`` are enlarged;
    ``positions`` are the particles (the last observed ones first) where the system has any.
    """

    images: Float[Tensor, "step view height width 3"]
    reconstruction: Float[Tensor, "view height width 3"]
    native: Float[Tensor, "step view resolution resolution 3"] | None
    positions: Float[Tensor, "time particle 3"] | None
    seconds: dict[str, float]

    @property
    def finite(self) -> bool:
        """Whether every predicted colour and position is a number."""
        parts = [self.images] if self.positions is None else [self.images, self.positions]
        return all(bool(torch.isfinite(part).all()) for part in parts)

    def images_uint8(self) -> NDArray[np.uint8]:
        """The predicted images as a screen shows them (what is not a number is black)."""
        return _uint8(self.images)

    def reconstruction_uint8(self) -> NDArray[np.uint8]:
        """The rendered last input frame as a screen shows it."""
        return _uint8(self.reconstruction)


def num_context_frames(system: PredictsVideo | PredictsViews) -> int:
    """How many frames up to the last input frame a system must see."""
    return system.num_context_frames if isinstance(system, PredictsViews) else NUM_CONTEXT_FRAMES


def views_seen(system: PredictsVideo | PredictsViews, input_views: Sequence[int], num_views: int) -> list[int]:
    """The views that a system looks through: ``input_views``, or all where it predicts each from its own frames."""
    return list(range(num_views)) if isinstance(system, PredictsViews) else list(input_views)


def without_depth(clip: Clip) -> Clip:
    """Return a clip whose input depth is nowhere measured, for systems that predict it."""
    return replace(clip, depth=torch.full_like(clip.depth, torch.nan))


def check_views(clip: Clip, input_views: Sequence[int]) -> None:
    """Raise ``ConfigError`` where the model looks through cameras that the recording does not have."""
    num_views = clip.rgb.shape[1]
    if not input_views or max(input_views) >= num_views:
        raise ConfigError(
            f"The model reads views {list(input_views)}, but {clip.name} has {num_views} (0 to {num_views - 1}).\n"
            "Use a data set with the cameras the model was trained with."
        )


def encode_clip(simulator: PredictsVideo, clip: Clip, input_views: Sequence[int]) -> Scene:
    """Encode the context frames of a clip as the input views see them, with what is driven if the system takes it."""
    check_views(clip, input_views)
    views = list(input_views)
    shown = clip.rgb[:, views], clip.depth[:, views], clip.cameras[:, views]
    if clip.context_driven is None or not takes_actions(simulator):
        return simulator.encode(*shown)
    return simulator.encode(*shown, driven=clip.context_driven)  # type: ignore[call-arg]


def roll_out_clip(simulator: PredictsVideo, scene: Scene, clip: Clip, num_steps: int) -> list[Particles]:
    """Roll a scene of ``encode_clip`` out, with the given motion of the clip if the system asks for it.

    What is driven stays where it is after the last frame of the clip.
    """
    motion = clip.target_driven
    if motion is None or not takes_actions(simulator):
        return simulator.rollout(scene, num_steps)
    missing = num_steps - len(motion.mask)
    if missing > 0:
        motion = motion.mapped(lambda values: torch.cat([values, values[-1:].expand(missing, *values.shape[1:])]))
    return simulator.rollout(scene, num_steps, driven=motion)  # type: ignore[call-arg]


def recorded_motion(simulator: PredictsVideo, path: Path, start: int, num_steps: int) -> Driven | None:
    """Return what a rollout from the frames ``start`` and ``start + 1`` is given; None for systems without actions."""
    return read_motion(path, start + NUM_CONTEXT_FRAMES, num_steps) if takes_actions(simulator) else None


def takes_actions(system: PredictsVideo | PredictsViews) -> bool:
    """Whether the motion of what is driven is an input of a system."""
    return bool(getattr(system, "takes_actions", False))


def stand_still(cameras: Cameras) -> bool:
    """Whether cameras (axes ``step view``) are the same at all steps."""
    return all(bool((matrix == matrix[:1]).all()) for matrix in (cameras.cam_to_world, cameras.intrinsics))


def render_steps(
    simulator: PredictsVideo, states: Sequence[Particles], cameras: Cameras
) -> Float[Tensor, "step view height width 3"]:
    """Render state ``i`` from cameras ``i`` (axes ``step view``); one call where the cameras stand still."""
    if stand_still(cameras):
        return simulator.render(states, cameras[0])
    return torch.cat([simulator.render([state], cameras[step]) for step, state in enumerate(states)])


def predict_clip(system: PredictsVideo | PredictsViews, clip: Clip, input_views: Sequence[int]) -> Prediction:
    """Predict the frames behind a clip as full images of all cameras, without gradients."""
    if isinstance(system, PredictsViews):
        return _predict_views(system, clip)
    return _predict_particles(system, clip, input_views)


def has_particles(scene: Scene) -> bool:
    """Whether a state has positions of its own: a single particle carries a vector of the whole scene, and no place."""
    return scene.current.num_particles > 1


def _predict_particles(simulator: PredictsVideo, clip: Clip, input_views: Sequence[int]) -> Prediction:
    """Encode, roll out and render one state at a time."""
    ticks = [_now()]
    scene = encode_clip(simulator, clip, input_views)
    ticks.append(_now())
    states = roll_out_clip(simulator, scene, clip, clip.target_rgb.shape[0])
    ticks.append(_now())
    images = render_steps(simulator, states, clip.target_cameras).float().cpu()
    ticks.append(_now())
    reconstruction = simulator.render([scene.current], clip.cameras[-1])[0].float().cpu()
    positions = trajectory_of(scene.current, states) if has_particles(scene) else None
    return Prediction(images, reconstruction, None, positions, _seconds(ticks))


@torch.no_grad()
def _predict_views(system: PredictsViews, clip: Clip) -> Prediction:
    """Encode, roll out and decode every view by itself."""
    ticks = [_now()]
    slots = system.encode_views(clip.rgb)
    ticks.append(_now())
    following = system.rollout_views(slots, clip.target_rgb.shape[0])
    ticks.append(_now())
    native = system.decode(following).transpose(0, 1).float().cpu()
    ticks.append(_now())
    reconstruction = system.decode(slots[:, -1]).float().cpu()
    height, width = clip.target_rgb.shape[-3:-1]
    images, reconstruction = (resize_images(part, (height, width)) for part in (native, reconstruction))
    return Prediction(images, reconstruction, native, None, _seconds(ticks))


def _uint8(colors: Tensor) -> NDArray[np.uint8]:
    return (colors.nan_to_num(0.0).clamp(0, 1) * 255).round().to(torch.uint8).numpy()


def _seconds(ticks: Sequence[float]) -> dict[str, float]:
    parts = ("encode", "rollout", "render")
    return {name: end - start for name, start, end in zip(parts, ticks[:-1], ticks[1:], strict=True)}


def _now() -> float:
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return time.perf_counter()
