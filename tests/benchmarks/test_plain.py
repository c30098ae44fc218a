"""The baseline computes the same as the fast path: same weights, same draws, other code."""

from contextlib import nullcontext

import pytest
import torch
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from benchmarks import stages
from benchmarks.arithmetic import dynamics_layers, edge_counts, encoder_layers, renderer_layers, work
from benchmarks.plain import dynamics as plain_dynamics
from benchmarks.plain import renderer as plain_renderer
from benchmarks.plain.literal import LiteralVPD
from benchmarks.plain.simulator import plain
from benchmarks.worlds import picture_rays, surface_particles, two_frames, video_batch
from vpd_lightning.losses.pixel import PixelLoss
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.simulator import Simulator

KEYS = RandomKeys.fixed(1)


def small_simulator(saves_memory: bool = False) -> Simulator:
    simulator = stages.build_simulator(
        "mujoco",
        ("unet_small", {"num_particles": 200}),
        ("hierarchical_gnn_small", {"num_abstract_nodes": 32, "r_s": 0.5, "r_a_s": 0.6}),
        ("point_nerf_small", {"checkpoint_chunks": saves_memory, "ray_chunk_size": 8 if saves_memory else 1024}),
        checkpoint_dynamics=saves_memory,
        pixel_gradient_to_motion=1.0,
    )
    torch.manual_seed(1)
    for field in (simulator.renderer.coarse, simulator.renderer.fine):
        torch.nn.init.normal_(field.density.weight, std=0.3)  # a field that stops light somewhere
    return simulator.train()


def loss_and_gradients(simulator: Simulator, dtype: torch.dtype, is_plain: bool) -> tuple[Tensor, Tensor]:
    batch = video_batch(32, 2, 16).to(dtype)
    with plain(simulator, num_steps=2) if is_plain else nullcontext():
        loss = PixelLoss(weight=1.0, coarse_weight=1.0)(simulator(batch), batch)
        loss.backward()
    return loss.detach(), torch.cat([parameter.grad.flatten() for parameter in simulator.parameters()])


@pytest.mark.parametrize("saves_memory", [False, True])
@pytest.mark.parametrize(
    ("dtype", "loss_tolerance", "gradient_tolerance"),
    # float32: sums of thousands of terms in another order; float64 leaves no room for another formula.
    [(torch.float32, 1e-5, 1e-4), (torch.float64, 1e-12, 1e-9)],
)
def test_plain_training_step_has_the_loss_and_the_gradients_of_the_fast_one(
    saves_memory: bool, dtype: torch.dtype, loss_tolerance: float, gradient_tolerance: float
):
    here = loss_and_gradients(small_simulator(saves_memory).to(dtype), dtype, is_plain=False)
    there = loss_and_gradients(small_simulator(saves_memory).to(dtype), dtype, is_plain=True)

    assert abs(float(here[0] / there[0]) - 1) < loss_tolerance
    assert float((here[1] - there[1]).norm() / there[1].norm()) < gradient_tolerance
    assert float(there[1].norm()) > 0


def test_plain_context_leaves_the_simulator_as_it_was():
    simulator = small_simulator()
    before = {name: dict(vars(part)) for name, part in simulator.named_children()}

    with plain(simulator, num_steps=2):
        assert "forward" in vars(simulator.renderer)

    assert {name: dict(vars(part)) for name, part in simulator.named_children()} == before


def test_operations_counted_from_shapes_are_those_of_the_plain_path():
    dynamics = stages.build("dynamics/hierarchical_gnn_small", "mujoco", num_abstract_nodes=40, r_s=0.4, r_a_s=0.5)
    renderer = stages.build("renderer/point_nerf_small", "mujoco")
    encoder = stages.build("encoder/unet_small", "mujoco")
    # With as many abstract nodes as particles every draw of them has the same edges.
    previous, current = two_frames(40)
    particles, rays = surface_particles(50), picture_rays(16, 10)
    counters = [FlopCounterMode(display=False) for _ in range(3)]
    with torch.no_grad():
        with counters[0]:
            plain_dynamics.advance(dynamics, previous, current, None, KEYS, 0)
        with counters[1]:
            plain_renderer.render(renderer, particles, rays, None)
        with counters[2]:
            encoder.network(torch.zeros(2, 3, 32, 32))

    counts = edge_counts(dynamics, previous, current)
    # The counter takes the sums over neighbours for products of matrices; those are not layers.
    num_samples = 10 * (2 * renderer.num_coarse_samples + renderer.num_fine_samples)
    kernel_sums = 2 * num_samples * renderer.num_neighbors * len(renderer.kernel_radii) * particles.features.shape[-1]
    expected = [
        work(dynamics_layers(dynamics, counts, is_plain=True)).operations,
        work(renderer_layers(renderer, 10, is_plain=True)).operations + kernel_sums,
        work(encoder_layers(encoder, 32, 32, 2)).operations,
    ]

    assert [counter.get_total_flops() for counter in counters] == expected
    assert work(dynamics_layers(dynamics, counts)).operations < expected[0]
    assert work(renderer_layers(renderer, 10)).operations < expected[1] - kernel_sums


def test_the_literal_vpd_has_the_networks_of_the_paper_and_learns_in_all_of_them():
    sizes = {"num_particles": 64, "num_nodes": 8, "num_coarse": 8, "num_fine": 8, "num_neighbors": 4}
    ours = stages.build_simulator(
        "mujoco", ("unet", {}), ("hierarchical_gnn", {}), ("point_nerf", {}), checkpoint_dynamics=False,
        pixel_gradient_to_motion=1.0,
    )  # fmt: skip
    torch.manual_seed(0)
    literal = LiteralVPD(**sizes, r_s=0.5, r_a_s=1.0)
    for name in ("encoder", "dynamics", "renderer"):
        counts = [sum(p.numel() for p in getattr(model, name).parameters()) for model in (ours, literal)]
        assert counts[0] == counts[1], name

    loss = literal(video_batch(32, 2, 8))
    loss.backward()

    assert loss.isfinite() and loss > 0
    assert all(parameter.grad is not None and parameter.grad.isfinite().all() for parameter in literal.parameters())
