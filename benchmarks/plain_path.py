"""The plain way to do the same: every pair written down, concatenated edges, dense convolutions, a render call a step.

Same weights, same draws, same results up to the order of sums. What it leaves out is what the fast path does.
"""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import fields, replace
from typing import Any

import torch
from torch import Tensor

from benchmarks.measuring import replaced
from vpd_lightning.dynamics.blocks import EdgeUpdater
from vpd_lightning.encoder import unet
from vpd_lightning.graph.neighbors import search
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.renderer.splat import SplatRenderer
from vpd_lightning.simulator import Simulator
from vpd_lightning.types import Particles, Rays, RenderedRays


def concatenated_edges(
    self: EdgeUpdater,
    edges: Tensor,
    sender_nodes: Tensor,
    receiver_nodes: Tensor | None,
    senders: Tensor,
    receivers: Tensor,
) -> Tensor:
    """Write the concatenation of edge, sender and receiver down and multiply it as it stands."""
    inputs = [edges, sender_nodes.index_select(0, senders)]
    if receiver_nodes is not None:
        inputs.append(receiver_nodes.index_select(0, receivers))
    return edges + self.norm(self.mlp(torch.cat(inputs, dim=-1)))


def splat_candidates(self: SplatRenderer, particles: Particles, origins: Tensor, directions: Tensor) -> Tensor:
    """Choose a ray's candidates from explicit differences to all particles, and sort them by one big selection."""
    offsets = particles.positions[:, None] - origins[:, :, None]
    along = (offsets * directions[:, :, None]).sum(dim=-1)
    square = (offsets - along[..., None] * directions[:, :, None]).square().sum(dim=-1)
    square = square + 1e6 * ~particles.mask[:, None]
    along = along + 1e4 * (self.near - along).clamp(min=0)
    beside = (square - (0.5 * self.kernel_scales[-1]) ** 2).clamp(min=0)
    first = (along + 1e4 * beside).amin(dim=-1, keepdim=True)
    score = square + 0.04 * (along - first - 3 * self.layer_depth).clamp(min=0).square()
    return score.topk(min(self.num_candidates, particles.num_particles), dim=-1, largest=False).indices


def _brute_force(*_: Any, **__: Any) -> str:
    return "torch"


@contextmanager
def plain(simulator: Simulator, num_steps: int) -> Iterator[None]:
    """Within this context the simulator takes the plain path through rollouts of ``num_steps`` steps."""
    batched = simulator.renderer.forward

    def one_step_per_call(particles: Particles, rays: Rays, keys: RandomKeys | None) -> RenderedRays:
        parts = []
        for step in range(num_steps):
            some = slice(step, None, num_steps)  # the batch axis is batch * time, time fastest
            here = None if keys is None else replace(keys, sample_index=keys.sample_index[some])
            parts.append(batched(_member(particles, some), _member(rays, some), here))
        return RenderedRays(**{item.name: _interleaved(parts, item.name) for item in fields(RenderedRays)})

    with ExitStack() as stack:
        stack.enter_context(replaced(search, "automatic_backend", _brute_force))
        stack.enter_context(replaced(EdgeUpdater, "forward", concatenated_edges))
        stack.enter_context(replaced(unet, "_GATHER_BELOW", 0.0))
        stack.enter_context(replaced(SplatRenderer, "_candidates", splat_candidates))
        stack.enter_context(replaced(simulator.renderer, "forward", one_step_per_call))
        yield


def _member(border: Any, some: slice) -> Any:
    """Take some members of the batch axis of particles or rays."""
    values = {item.name: getattr(border, item.name) for item in fields(border)}
    return type(border)(**{name: None if value is None else value[some] for name, value in values.items()})


def _interleaved(parts: Sequence[RenderedRays], name: str) -> Tensor | None:
    values = [getattr(part, name) for part in parts]
    return None if values[0] is None else torch.stack(values, dim=1).flatten(0, 1)
