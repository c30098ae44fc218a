"""A simulator that takes the plain path for a while: same weights, same draws, none of the fast path's tricks."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import fields, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from benchmarks.measuring import replaced
from benchmarks.plain import dynamics, renderer
from benchmarks.plain.splat import splat_candidates
from vpd_lightning.dynamics.hierarchical_gnn import HierarchicalGNNDynamics
from vpd_lightning.encoder import unet
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.renderer.point_nerf import PointNeRFRenderer
from vpd_lightning.renderer.splat import SplatRenderer
from vpd_lightning.simulator import Simulator
from vpd_lightning.types import Particles, Rays, RenderedRays


@contextmanager
def plain(simulator: Simulator, num_steps: int) -> Iterator[None]:
    """Within this context the simulator takes the plain path through rollouts of ``num_steps`` steps.

    Every pixel is convolved, edges are concatenated, sums scattered, products of samples, neighbours and kernels
    written down, each time step rendered by a call of its own, and nothing is computed again in the backward pass.
    Stages that have no plain way of their own stay as they are.
    """
    with ExitStack() as stack:
        render = simulator.renderer.forward
        if isinstance(simulator.renderer, PointNeRFRenderer):
            render = partial(renderer.render, simulator.renderer)
        if isinstance(simulator.renderer, SplatRenderer):
            stack.enter_context(replaced(SplatRenderer, "_candidates", splat_candidates))
        if isinstance(simulator.dynamics, HierarchicalGNNDynamics):
            advance = partial(dynamics.advance, simulator.dynamics)
            stack.enter_context(replaced(simulator.dynamics, "forward", advance))
        stack.enter_context(replaced(simulator, "checkpoint_dynamics", False))
        stack.enter_context(replaced(unet, "_GATHER_BELOW", 0.0))
        stack.enter_context(replaced(simulator.renderer, "forward", partial(_one_step_per_call, render, num_steps)))
        yield


def _one_step_per_call(
    render: Any, num_steps: int, particles: Particles, rays: Rays, keys: RandomKeys | None
) -> RenderedRays:
    parts = []
    for step in range(num_steps):
        some = slice(step, None, num_steps)  # the batch axis is batch * time, time fastest
        here = None if keys is None else replace(keys, sample_index=keys.sample_index[some])
        parts.append(render(_member(particles, some), _member(rays, some), here))
    return RenderedRays(**{item.name: _interleaved(parts, item.name) for item in fields(RenderedRays)})


def _member(border: Any, some: slice) -> Any:
    """Take some members of the batch axis of particles or rays."""
    values = {item.name: getattr(border, item.name) for item in fields(border)}
    return type(border)(**{name: None if value is None else value[some] for name, value in values.items()})


def _interleaved(parts: Sequence[RenderedRays], name: str) -> Tensor | None:
    values = [getattr(part, name) for part in parts]
    return None if values[0] is None else torch.stack(values, dim=1).flatten(0, 1)
