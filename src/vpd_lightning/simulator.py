"""The method on one screen: encode two frames, roll out, render. No Lightning, no Hydra."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from vpd_lightning.actions import after_step, check_frame, checked_motion, expanded, with_next
from vpd_lightning.dynamics.base import AbstractDynamics
from vpd_lightning.encoder.base import AbstractEncoder
from vpd_lightning.errors import ActionError
from vpd_lightning.geometry.cameras import pixel_rays
from vpd_lightning.geometry.occluders import with_driven
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.renderer.base import AbstractRenderer
from vpd_lightning.system import AbstractSystem
from vpd_lightning.types import (
    NUM_CONTEXT_FRAMES,
    Cameras,
    Driven,
    HiddenSide,
    Occluders,
    Particles,
    Rays,
    RenderedRays,
    RGBDFrames,
    SimulatorOutput,
    VideoBatch,
)


@dataclass(frozen=True)
class Scene:
    """Two encoded frames of one scene (batch axis of 1): all that a rollout needs."""

    previous: Particles
    current: Particles


@dataclass(frozen=True)
class Rollout:
    """The state of a rollout at one step, for programs that step it themselves; ``Simulator.start`` returns the first.

    ``particles`` are those after ``num_steps`` steps (batch axis of 1), ``previous`` those of the step before. It is
    immutable: ``step`` returns another rollout, so several plans may branch from the same one. It includes the memory
    of the dynamics, which two particle sets do not determine, so its steps equal those of ``Simulator.rollout``.
    """

    simulator: "Simulator"
    previous: Particles
    particles: Particles
    memory: Any
    keys: RandomKeys
    num_steps: int

    @torch.no_grad()
    def step(self, driven: Driven | None = None) -> "Rollout":
        """Return the rollout one step later.

        ``driven`` says where what is driven will be then (axes ``1 driven`` or ``batch 1 driven``, 1 being the step;
        several motions make a batch of as many rollouts). Without it, it stays where it is.

        Raises:
            ActionError: the motion does not fit the scene.
        """
        rollout, following = self, None
        if driven is not None:
            motion = checked_motion(self.particles, driven, 1)
            rollout, following = self.branched(len(motion.mask)), motion[:, 0]
        current = with_next(rollout.particles, following)
        predicted, memory = self.simulator.dynamics(
            rollout.previous, current, rollout.memory, rollout.keys, self.num_steps
        )
        predicted = after_step(predicted, current)
        return replace(
            rollout, previous=rollout.particles, particles=predicted, memory=memory, num_steps=self.num_steps + 1
        )

    def branched(self, count: int) -> "Rollout":
        """Return ``count`` equal rollouts as one, a batch, to try as many actions; those already as many stay."""
        if count == len(self.particles.mask):
            return self
        parts = {name: expanded(getattr(self, name), count) for name in ("previous", "particles", "memory", "keys")}
        return replace(self, **parts)


class Simulator(AbstractSystem):
    """Visual Particle Dynamics (paper section 3): encoder, dynamics and renderer, trained end to end from pixels.

    ``location_noise`` is the standard deviation (metres) of the noise on particle positions during training rollouts.
    ``checkpoint_dynamics`` recomputes each dynamics step in the backward pass: exact gradients, less memory.
    ``pixel_gradient_to_motion`` is the share of the gradient of rendered rays that reaches predicted positions
    (features get all of it): 1 is the paper; with a loss on motion itself, 0 keeps a renderer that is not
    trained yet from moving bodies.
    """

    num_context_frames = NUM_CONTEXT_FRAMES

    def __init__(
        self,
        *,
        encoder: AbstractEncoder,
        dynamics: AbstractDynamics,
        renderer: AbstractRenderer,
        location_noise: float,
        checkpoint_dynamics: bool,
        pixel_gradient_to_motion: float,
    ):
        super().__init__()
        if location_noise < 0:
            raise ValueError(f"location_noise must not be negative, got {location_noise}")
        self.encoder, self.dynamics, self.renderer = encoder, dynamics, renderer
        if not 0 <= pixel_gradient_to_motion <= 1:
            raise ValueError(f"pixel_gradient_to_motion must lie between 0 and 1, got {pixel_gradient_to_motion}")
        self.location_noise, self.checkpoint_dynamics = location_noise, checkpoint_dynamics
        self.pixel_gradient_to_motion = pixel_gradient_to_motion

    def forward(self, batch: VideoBatch) -> SimulatorOutput:
        """Predict the rays of every step of the batch; all steps are rendered in one call.

        ``auxiliary`` is what the encoder offers of the current frame, and of the one before as ``previous_NAME``; where
        the batch holds future frames, what it observes of them, too, as ``future_NAME``.
        """
        previous = self.encoder(batch.context[:, 0], batch.keys, "previous")
        current = self.encoder(batch.context[:, 1], batch.keys, "current")
        num_steps = batch.rays.origins.shape[1]
        states = self.unroll(previous.particles, current.particles, num_steps, batch.keys, batch.driven)
        shown = [self._shown(state) for state in states]
        observed = self._observed(batch)
        # The light is learned from shadows of what is seen later: those of bodies in the wrong place would mislead it.
        casting = _occluders(observed, batch.driven) if self.training else None
        rendered = self._render_steps(shown, batch.rays, batch.keys if self.training else None, casting)
        before = {f"previous_{name}": value for name, value in previous.auxiliary.items()}
        return SimulatorOutput(rendered, states, current.auxiliary | before | observed)

    def _shown(self, state: Particles) -> Particles:
        """Return a state whose positions get their share of the gradient of what is rendered."""
        share = self.pixel_gradient_to_motion
        if share == 1:
            return state
        still = state.positions.detach()
        return replace(state, positions=still + share * (state.positions - still) if share else still)

    def _observed(self, batch: VideoBatch) -> dict[str, Tensor]:
        """Return what the encoder observes of the future frames as ``future_NAME`` (axes ``batch time ...``)."""
        if batch.future is None:
            return {}
        steps = range(batch.future.depth.shape[1])
        seen = [self.encoder.observe(batch.future[:, step], batch.keys, str(step)) for step in steps]
        return {f"future_{name}": torch.stack([step[name] for step in seen], dim=1) for name in seen[0]}

    def unroll(
        self,
        previous: Particles,
        current: Particles,
        num_steps: int,
        keys: RandomKeys,
        driven: Driven | None = None,
    ) -> list[Particles]:
        """Apply the dynamics ``num_steps`` times; returns the predicted states, the first one a step after current.

        ``driven`` is the given motion at these steps (axes ``batch step``). Motions for a batch of one scene make a
        batch of rollouts from what was found once of the scene.
        """
        memory = self.dynamics.initialize(previous, current, keys)
        if driven is not None and len(driven.mask) != len(current.mask):
            count = len(driven.mask)
            previous, current = expanded(previous, count), expanded(current, count)
            memory, keys = expanded(memory, count), expanded(keys, count)
        states = []
        for rollout_step in range(num_steps):
            noisy = self._add_location_noise(current, keys, rollout_step)
            noisy = with_next(noisy, None if driven is None else driven[:, rollout_step])
            arguments = (previous, noisy, memory, keys, rollout_step)
            if self.checkpoint_dynamics and torch.is_grad_enabled():
                following, memory = checkpoint(self.dynamics, *arguments, use_reentrant=False, preserve_rng_state=False)
            else:
                following, memory = self.dynamics(*arguments)
            following = after_step(following, noisy)
            previous, current = noisy, following
            states.append(following)
        return states

    def _add_location_noise(self, particles: Particles, keys: RandomKeys, rollout_step: int) -> Particles:
        if not self.training or self.location_noise == 0:
            return particles
        # Paper: noise on locations in training, and no more is said. Here it comes before each step, on the current
        # particles alone; the predicted ones are offsets from those, so over a rollout it adds up to a random walk.
        shape = particles.positions.shape[1:]
        noise = torch.stack([torch.randn(shape, generator=g) for g in keys.generators(f"noise/{rollout_step}")])
        return replace(particles, positions=particles.positions + self.location_noise * noise.to(particles.positions))

    def _render_steps(
        self, states: Sequence[Particles], rays: Rays, keys: RandomKeys | None, occluders: Occluders | None = None
    ) -> RenderedRays:
        """Render ``batch time ray`` rays of a list of states as one batch of ``batch * time`` scenes."""
        batch_size, num_steps = rays.origins.shape[:2]

        def flatten(tensors: Sequence[Tensor]) -> Tensor:
            return torch.stack(list(tensors), dim=1).flatten(0, 1)

        def flattened(kind: type, field: str) -> Any:
            """Return a part of the states with an axis of its own; its features may be missing."""
            parts = [getattr(state, field) for state in states]
            names = [item.name for item in fields(kind) if getattr(parts[0], item.name, None) is not None]
            return kind(**{name: flatten([getattr(part, name) for part in parts]) for name in names}) if names else None

        particles = Particles(
            positions=flatten([s.positions for s in states]),
            features=flatten([s.features for s in states]),
            mask=flatten([s.mask for s in states]),
            moving=None if states[0].moving is None else flatten([s.moving for s in states]),  # type: ignore[misc]
            normals=None if states[0].normals is None else flatten([s.normals for s in states]),  # type: ignore[misc]
            scenery=states[0].scenery,
            occluders=occluders,
            hidden_side=flattened(HiddenSide, "hidden_side"),
            driven=flattened(Driven, "driven"),
        )
        flat_rays = Rays(rays.origins.flatten(0, 1), rays.directions.flatten(0, 1))
        if keys is not None:  # one set of draws per (member, step); steps stay apart for up to a million steps
            index = [member * 1_000_000 + t for member in keys.sample_index for t in range(num_steps)]
            keys = replace(keys, sample_index=index)
        rendered = self.renderer(particles, flat_rays, keys)

        def restore(tensor: Tensor | None) -> Tensor | None:
            return None if tensor is None else tensor.unflatten(0, (batch_size, num_steps))

        return RenderedRays(
            rgbs=restore(rendered.rgbs),  # type: ignore[arg-type]
            depths=restore(rendered.depths),  # type: ignore[arg-type]
            opacities=restore(rendered.opacities),  # type: ignore[arg-type]
            coarse_rgbs=restore(rendered.coarse_rgbs),
        )

    @torch.no_grad()
    def predict_frames(
        self, context: RGBDFrames, cameras: Cameras, driven: Driven | None = None
    ) -> Float[Tensor, "step view height width 3"]:
        """Encode the two frames of the input views, roll out, and render step ``i`` from the cameras ``i``.

        ``driven`` is the given motion at these steps (axis ``step``).
        """
        scene = self.encode(context.rgb, context.depth, context.cameras, driven=context.driven)
        states = self.rollout(scene, cameras.shape[0], driven=driven)
        return torch.cat([self.render([state], cameras[step]) for step, state in enumerate(states)])

    @property
    def takes_actions(self) -> bool:
        """Whether the motion of what is driven is an input."""
        return any(getattr(stage, "has_driven", False) for stage in (self.encoder, self.dynamics))

    # The Python interface to a trained model.

    @torch.no_grad()
    def encode(
        self,
        rgb: Tensor | np.ndarray,
        depth: Tensor | np.ndarray,
        cameras: Cameras,
        keys: RandomKeys | None = None,
        driven: Driven | None = None,
    ) -> Scene:
        """Encode two frames: ``rgb`` (2, view, height, width, 3) uint8 or [0, 1], ``depth`` in metres, floating point.

        Images are tensors or NumPy arrays (``Cameras.from_arrays`` makes cameras of arrays). ``cameras`` has axes
        ``view`` or ``2 view``. The draws (particle subsample) are the same every time, unless ``keys`` (for a batch of
        one) says otherwise. The current particles come with what the dynamics guesses of their hidden side.

        ``driven`` is where what is driven (a robot) was in both frames (axes ``2 driven``), for a model that was
        trained with actions.

        Raises:
            ValueError: shapes or types that are none of these.
            ActionError: the model takes no actions, or what is driven is not where it is said to be.
        """
        self.eval()
        if driven is not None and not self.takes_actions:
            raise ActionError("this model was trained without actions.\nTrain one with actions=true.")
        rgb, depth = torch.as_tensor(rgb), torch.as_tensor(depth)
        if not depth.is_floating_point():
            raise ValueError(f"depth must be in metres, as floating point, got {depth.dtype}")
        if rgb.shape[:1] != (2,) or rgb.shape[:-1] != depth.shape:
            raise ValueError(
                f"rgb must be (2, view, height, width, 3) and depth (2, view, height, width); "
                f"got {tuple(rgb.shape)} and {tuple(depth.shape)}"
            )
        parameter = next(self.parameters())
        keys = keys or RandomKeys.fixed(1)
        depth = depth.to(parameter)
        rgb = (rgb if rgb.is_floating_point() else rgb.to(parameter.dtype) / 255).to(parameter)
        cameras = cameras.to(parameter.device, parameter.dtype)
        states = []
        for time, purpose in enumerate(("previous", "current")):
            here = cameras[time] if len(cameras.shape) == 2 else cameras
            frames = RGBDFrames(rgb[time][None], depth[time][None], here[None], _one_of(driven, time, depth))
            check_frame(frames)
            states.append(self.encoder(frames, keys, purpose).particles)
        previous, current = states
        return Scene(previous, self.dynamics.completed(previous, current, keys))

    @torch.no_grad()
    def rollout(
        self, scene: Scene, num_steps: int, keys: RandomKeys | None = None, driven: Driven | None = None
    ) -> list[Particles]:
        """Return the predicted particles of the next ``num_steps`` steps (batch axis of 1).

        ``driven`` is where what is driven will be after each step (axes ``step driven``; without it, it stays). Several
        motions (axes ``batch step driven``) roll out side by side, and the particles get that batch axis.

        Raises:
            ActionError: the motion is too short, not finite, of other points than the scene's, or jumps.
        """
        self.eval()
        motion = None if driven is None else checked_motion(scene.current, driven, num_steps)
        return self.unroll(scene.previous, scene.current, num_steps, keys or RandomKeys.fixed(1), motion)

    @torch.no_grad()
    def start(self, scene: Scene, keys: RandomKeys | None = None) -> Rollout:
        """Return a rollout that stands at the scene and is taken on step by step."""
        self.eval()
        keys = keys or RandomKeys.fixed(1)
        memory = self.dynamics.initialize(scene.previous, scene.current, keys)
        return Rollout(self, scene.previous, scene.current, memory, keys, 0)

    @torch.no_grad()
    def render(self, states: Sequence[Particles], cameras: Cameras) -> Float[Tensor, "time view height width 3"]:
        """Render full images of the states from the cameras (axis ``view``); colours in [0, 1]."""
        return self.render_maps(states, cameras).rgbs.clamp(0, 1)

    @torch.no_grad()
    def render_maps(self, states: Sequence[Particles], cameras: Cameras) -> RenderedRays:
        """Render colour, expected distance along the ray and opacity, axes ``time view height width``.

        One state at a time, so that memory does not grow with the length of the rollout.
        """
        self.eval()
        parameter = next(self.parameters())
        rays = pixel_rays(cameras.to(parameter.device, parameter.dtype))
        flat = Rays(rays.origins.flatten(0, -2)[None], rays.directions.flatten(0, -2)[None])
        images = [self.renderer(state, flat, None) for state in states]
        shape = rays.origins.shape[:-1]
        return RenderedRays(
            rgbs=torch.stack([image.rgbs[0].reshape(*shape, 3) for image in images]),
            depths=torch.stack([image.depths[0].reshape(shape) for image in images]),
            opacities=torch.stack([image.opacities[0].reshape(shape) for image in images]),
        )


def _one_of(driven: Driven | None, time: int, like: Tensor) -> Driven | None:
    """Return what is driven at one of two frames, with a batch axis of 1."""
    if driven is None:
        return None
    if driven.mask.dim() != 2 or len(driven.mask) != 2:
        raise ValueError(f"driven must have axes (2, point), for both frames; got {tuple(driven.mask.shape)}")
    return driven[time][None].to(like.device, like.dtype)


def _occluders(observed: dict[str, Tensor], driven: Driven | None) -> Occluders | None:
    """Return what was seen to move and what was driven at each predicted step, axes ``batch * time``."""
    if "future_positions" not in observed:
        return None
    occluders = Occluders(observed["future_positions"].flatten(0, 1), observed["future_mask"].flatten(0, 1))
    return with_driven(occluders, None if driven is None else driven.mapped(lambda values: values.flatten(0, 1)))
