"""The real encoder, the paper's graph network and a real renderer learn from pixels alone how balls fly.

In two stages, as ``model=vpd_staged``: first encoder and renderer on single frames, then the dynamics through both as
they are. Each ball has its own velocity, which only the difference of the two context frames tells: nothing that is the
same in all scenes can come near it.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from vpd_lightning.dynamics.hierarchical_gnn import HierarchicalGNNDynamics
from vpd_lightning.encoder.base import EncoderOutput
from vpd_lightning.encoder.unet import UNetEncoder
from vpd_lightning.graph.incidence import Incidence
from vpd_lightning.renderer.splat import SplatRenderer
from vpd_lightning.simulator import Simulator
from vpd_lightning.testing.free_flight import FAR, NEAR, WORKSPACE_MAX, WORKSPACE_MIN, Flights, FreeFlight
from vpd_lightning.training.optimization import WarmupCosineAdam
from vpd_lightning.types import Particles, RenderedRays

FEATURE_DIM = 8
SCENE = FreeFlight(num_cameras=2, speed=0.1)
BATCH, RAYS = 8, 512
DRAWING, MOVING = 300, 200  # updates


def small_simulator() -> Simulator:
    """Two of the paper's ten message-passing steps, 64 of its 128 units; everything else is there."""
    torch.manual_seed(0)
    return Simulator(
        encoder=UNetEncoder(
            channels=[8, 16, FEATURE_DIM], num_particles=256, workspace_min=WORKSPACE_MIN, workspace_max=WORKSPACE_MAX,
            moving_fraction=None, background=None, use_normals=False, color_features=True, same_pixels=True,
            has_scenery=False, has_driven=False,
        ),
        dynamics=HierarchicalGNNDynamics(
            feature_dim=FEATURE_DIM, hidden_dim=64, message_passing_steps=2, num_abstract_nodes=32,
            max_abstract_neighbors=2, r_s=0.25, r_a_s=0.6, location_scale=0.1, feature_limit=1e4,
            neighbors_backend="auto", edge_capacity=None, max_abstract_edges_per_node=None, compile=False,
            zero_init_decoders=False, normalized_edges=True, edge_gain=3.0, aggregation="mean", update_features=False,
            has_driven=False,
        ),
        renderer=SplatRenderer(
            feature_dim=FEATURE_DIM, color_features=True, background_frequencies=4, hidden_dim=32, num_layers=2,
            num_candidates=16, surface_scale=0.3, kernel_scales=[0.15, 0.4, 1.0], layer_depth=1.0, near=NEAR, far=FAR,
            ray_chunk_size=2048, candidate_backend="auto",
            facing_softness=None, has_scenery=False, num_scenery_candidates=12, elliptic_footprints=True,
            far_pixels=False, seen_through=False,
            unseen_ground=False, num_lights=0, num_occluders=9, shadow_softness=0.5,
        ),
        location_noise=0.0, checkpoint_dynamics=False, pixel_gradient_to_motion=1.0,
    )  # fmt: skip


def encoded(simulator: Simulator, flights: Flights) -> tuple[Particles, Particles]:
    context, keys = flights.batch.context, flights.batch.keys
    previous, current = (simulator.encoder(context[:, time], keys, str(time)).particles for time in range(2))
    return previous, current


def train(simulator: Simulator, lr: float, num_updates: int, still: bool) -> None:
    """Take updates from the squared error of the pixels; ``still``: of the last context frame, and nothing moves."""
    optimizer, schedule = WarmupCosineAdam(
        lr=lr, betas=[0.9, 0.999], eps=1e-8, stage_multipliers={}, warmup_steps=50, final_share=0.0
    ).build(simulator, num_updates)
    for step in range(num_updates):
        flights = SCENE.flights(int(still), step, BATCH, 1, RAYS, still=still)
        previous, current = encoded(simulator, flights)
        states = [current] if still else simulator.unroll(previous, current, 1, flights.batch.keys)
        rendered = simulator._render_steps([simulator._shown(state) for state in states], flights.batch.rays, None)
        optimizer.zero_grad()
        (rendered.rgbs - flights.batch.rgbs).square().mean().backward()
        torch.nn.utils.clip_grad_norm_(simulator.parameters(), 1.0)
        optimizer.step()
        schedule.step()


@torch.no_grad()
def motion_of_balls(simulator: Simulator) -> tuple[Tensor, Tensor]:
    """Return predicted and true displacement of each ball's centre in one step, in scenes that were not trained on."""
    flights = SCENE.flights(999, 0, 32, 1, 1)
    previous, current = encoded(simulator, flights)
    moved = simulator.unroll(previous, current, 1, flights.batch.keys)[0].positions - current.positions
    body = flights.body_of(current.positions)
    own = torch.stack([(body == number).float() for number in range(2)], dim=1)
    seen = own.sum(dim=-1) >= 3
    assert seen.float().mean() > 0.9
    centers = (own @ moved) / own.sum(dim=-1, keepdim=True).clamp(min=1)
    return centers[seen], flights.displacements[:, 0][seen]


def learned(simulator: Simulator) -> tuple[float, float]:
    """Train; return the mean error of the balls' centres as a share of their motion, and the correlation with it."""
    train(simulator, 4e-3, DRAWING, still=True)
    simulator.encoder.requires_grad_(False)
    simulator.renderer.requires_grad_(False)
    train(simulator, 6e-4, MOVING, still=False)
    predicted, true = motion_of_balls(simulator)
    share = (predicted - true).norm(dim=-1).mean() / true.norm(dim=-1).mean()
    together = torch.stack([(each - each.mean(dim=0)).flatten() for each in (predicted, true)])
    return float(share), float(torch.corrcoef(together)[0, 1])


@contextmanager
def one_thread() -> Iterator[None]:
    """So that sums are added in the same order everywhere, and several tests fit on one machine."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def test_velocities_are_learned_from_pixels() -> None:
    with one_thread():
        share, correlation = learned(small_simulator())
    assert share < 0.9 and correlation > 0.45, (share, correlation)


def features_of_other_pixels(simulator: Simulator, patch: pytest.MonkeyPatch) -> None:
    """A particle lies where its pixel's depth says, and looks as another pixel does."""
    encode = simulator.encoder.forward

    def broken(*arguments: Any) -> EncoderOutput:
        output = encode(*arguments)
        particles = output.particles
        return replace(output, particles=replace(particles, features=particles.features.roll(64, dims=1)))

    patch.setattr(simulator.encoder, "forward", broken)


def messages_are_lost(simulator: Simulator, patch: pytest.MonkeyPatch) -> None:
    """What edges tell nodes is zero."""
    mean = Incidence.mean
    patch.setattr(Incidence, "mean", lambda *arguments: 0 * mean(*arguments))


def positions_get_no_gradient(simulator: Simulator, patch: pytest.MonkeyPatch) -> None:
    """The renderer draws what it should and hides where its particles came from."""
    render = simulator.renderer.forward

    def broken(particles: Particles, *arguments: Any) -> RenderedRays:
        positions = particles.positions.detach() + 0 * particles.positions
        return render(replace(particles, positions=positions), *arguments)

    patch.setattr(simulator.renderer, "forward", broken)


@pytest.mark.exhaustive
@pytest.mark.parametrize("fault", [features_of_other_pixels, messages_are_lost, positions_get_no_gradient])
def test_nothing_is_learned_where_a_stage_is_broken(
    fault: Callable[[Simulator, pytest.MonkeyPatch], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    simulator = small_simulator()
    fault(simulator, monkeypatch)
    with one_thread():
        share, correlation = learned(simulator)
    assert share > 0.95 and correlation < 0.3, (share, correlation)
