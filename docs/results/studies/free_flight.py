"""Which link of VPD fails to learn motion: the stages taken apart on two balls in free flight.

``python -m docs.results.studies.free_flight OUT.json [--rows NAME ...] [--updates 600]`` trains the paper's graph
network on scenes that never repeat, once for each row, and writes how far the centre of each ball is from where it
truly is.

- ``targets``: the network alone, from the true displacement of every particle.
- ``ready``: from pixels, through an encoder and a renderer that have learned to draw from the true motion and stay.
- ``stills``: from pixels, through an encoder and a renderer that have learned to draw single frames and stay
  (``model=vpd_staged``): nothing but pixels teaches any stage.
- ``own``: from pixels, encoder, network and renderer together, as in the paper.

It also writes where the gradient of the pixels pushes a ball that stands still: the cosine between that and its true
displacement, for each width of the renderer's kernels (``--gradients``).
"""

import argparse
import functools
import json
import math
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from vpd_lightning.dynamics.hierarchical_gnn import HierarchicalGNNDynamics
from vpd_lightning.encoder.unet import UNetEncoder
from vpd_lightning.files import AtomicPath
from vpd_lightning.renderer.splat import SplatRenderer
from vpd_lightning.simulator import Simulator
from vpd_lightning.testing.free_flight import FAR, NEAR, WORKSPACE_MAX, WORKSPACE_MIN, Flights, FreeFlight
from vpd_lightning.training.muon import WarmupCosineMuon
from vpd_lightning.types import Particles

FEATURE_DIM = 16
HORIZONS = (1, 4, 8)
SCENE = FreeFlight()
TEST_SEED, NUM_TEST = 999, 32


@dataclass(frozen=True)
class Row:
    """One training; the network is the paper's (10 steps, 128 wide) but for its number of abstract nodes."""

    link: str
    same_pixels: bool = True
    normalized_edges: bool = True
    aggregation: str = "mean"
    zero_init: bool = False
    surface_scale: float = 0.3
    num_steps: int = 1
    batch_size: int = 8
    rays_per_step: int = 1024
    message_passing_steps: int = 10
    update_features: bool = True
    dynamics_rate: float = 3e-4
    muon_rate: float | None = None
    num_abstract_nodes: int = 32
    r_s: float = 0.4
    r_a_s: float = 0.8
    edge_gain: float = 1.0


STAGED = Row("stills", update_features=False, num_abstract_nodes=64, r_s=0.25, r_a_s=0.4, edge_gain=3.0)
ROWS = {
    "targets": Row("targets"),
    "targets, two draws of pixels": Row("targets", same_pixels=False),
    "targets, edges in metres and summed": Row("targets", normalized_edges=False, aggregation="sum"),
    "targets, decoders start at zero": Row("targets", zero_init=True),
    "ready renderer, wide kernels": Row("ready"),
    "ready renderer, narrow kernels": Row("ready", surface_scale=0.1),
    "ready renderer, wide kernels, features stay": Row("ready", update_features=False),
    "renderer of stills": STAGED,
    "renderer of stills, Muon": replace(STAGED, muon_rate=1.2e-3),
    "renderer of stills, rate of 1e-3": replace(STAGED, dynamics_rate=1e-3),
    "renderer of stills, features updated": replace(STAGED, update_features=True),
    "renderer of stills, few abstract nodes": Row("stills", update_features=False),
    "own renderer, wide kernels": Row("own"),
    "own renderer, narrow kernels": Row("own", surface_scale=0.1),
}


class Training:
    """One row: its simulator, and a step of the training."""

    def __init__(self, row: Row, seed: int, num_updates: int) -> None:
        torch.manual_seed(seed)
        self.row, self.seed, self.num_updates = row, seed, num_updates
        self.simulator = Simulator(
            encoder=UNetEncoder(
                channels=[16, 32, 64, 32, FEATURE_DIM], num_particles=512, workspace_min=WORKSPACE_MIN,
                workspace_max=WORKSPACE_MAX, moving_fraction=None, background=None, use_normals=False,
                color_features=True, same_pixels=row.same_pixels, has_scenery=False, has_driven=False,
            ),
            dynamics=HierarchicalGNNDynamics(
                feature_dim=FEATURE_DIM, hidden_dim=128, message_passing_steps=row.message_passing_steps,
                num_abstract_nodes=row.num_abstract_nodes, max_abstract_neighbors=2, r_s=row.r_s, r_a_s=row.r_a_s,
                location_scale=0.1, feature_limit=1e4, neighbors_backend="auto", edge_capacity=None,
                max_abstract_edges_per_node=None, compile=False, zero_init_decoders=row.zero_init,
                normalized_edges=row.normalized_edges, edge_gain=row.edge_gain, aggregation=row.aggregation,
                update_features=row.update_features, has_driven=False,
            ),
            renderer=SplatRenderer(
                feature_dim=FEATURE_DIM, color_features=True, background_frequencies=4, hidden_dim=96, num_layers=3,
                num_candidates=24, surface_scale=row.surface_scale, kernel_scales=[0.15, 0.4, 1.0], layer_depth=1.0,
                near=NEAR, far=FAR, ray_chunk_size=2048, candidate_backend="auto", facing_softness=None,
                has_scenery=False, num_scenery_candidates=12, elliptic_footprints=True, far_pixels=False,
                seen_through=False, unseen_ground=False, num_lights=0, num_occluders=9, shadow_softness=0.5,
            ),
            location_noise=0.0, checkpoint_dynamics=False, pixel_gradient_to_motion=1.0,
        )  # fmt: skip
        pictures = [*self.simulator.encoder.parameters(), *self.simulator.renderer.parameters()]
        dynamics = WarmupCosineMuon(
            lr=row.dynamics_rate, muon_lr=row.muon_rate, muon_momentum=0.95, betas=(0.9, 0.999), eps=1e-8,
            stage_multipliers={}, warmup_steps=50, final_share=0.02,
        )  # fmt: skip
        self.optimizers = [
            torch.optim.Adam(pictures, lr=2e-3),
            dynamics.optimizer([{"params": list(self.simulator.dynamics.parameters()), "lr": row.dynamics_rate}]),
        ]
        self.groups = [group for optimizer in self.optimizers for group in optimizer.param_groups]
        self.rates = [group["lr"] for group in self.groups]

    def learn_to_draw(self, num_updates: int) -> None:
        """Train encoder and renderer on particles that are moved as the balls truly move, or on single frames."""
        for step in range(num_updates):
            flights = self.flights(step, still=self.row.link == "stills")
            _, current = self.encoded(flights)
            true = flights.true_displacements(current.positions)
            states = [replace(current, positions=current.positions + moved) for moved in true.unbind(dim=1)]
            self._update(self.pixel_error(states, flights), _rate(step, num_updates))
        for stage in (self.simulator.encoder, self.simulator.renderer):
            stage.requires_grad_(False)

    def step(self, step: int) -> None:
        """Take one update of the row's own kind."""
        flights = self.flights(step)
        with torch.autocast("cpu", torch.bfloat16):
            previous, current = self.encoded(flights)
            states = self.simulator.unroll(previous, current, self.row.num_steps, flights.batch.keys)
            if self.row.link == "targets":
                moved = torch.stack([state.positions - current.positions for state in states], dim=1)
                error = (moved - flights.true_displacements(current.positions)).square().sum(dim=-1).mean()
            else:
                error = self.pixel_error(states, flights)
        self._update(error, _rate(step, self.num_updates))

    def _update(self, error: Tensor, rate: float) -> None:
        for group, full in zip(self.groups, self.rates, strict=True):
            group["lr"] = rate * full
        for optimizer in self.optimizers:
            optimizer.zero_grad()
        error.backward()
        torch.nn.utils.clip_grad_norm_(self.simulator.parameters(), 1.0)
        for optimizer in self.optimizers:
            optimizer.step()

    def flights(self, step: int, still: bool = False) -> Flights:
        row = self.row
        return SCENE.flights(self.seed, step, row.batch_size, row.num_steps, row.rays_per_step, still=still)

    def encoded(self, flights: Flights) -> tuple[Particles, Particles]:
        """Return previous and current particles; those that learn from targets have the colours as features."""
        context, keys = flights.batch.context, flights.batch.keys
        made = [self.simulator.encoder(context[:, time], keys, name).particles for time, name in enumerate(("a", "b"))]
        if self.row.link == "targets":
            made = [replace(one, features=torch.nn.functional.pad(one.colors, (0, FEATURE_DIM - 3))) for one in made]
        return made[0], made[1]

    def pixel_error(self, states: Sequence[Particles], flights: Flights) -> Tensor:
        rendered = self.simulator._render_steps(list(states), flights.batch.rays, None)
        return (rendered.rgbs - flights.batch.rgbs).square().mean()

    @torch.no_grad()
    def measured(self) -> dict[str, Any]:
        """Return mean distances (cm) of the balls' centres from the truth, those of the references, and PSNR."""
        self.simulator.eval()
        flights = SCENE.flights(TEST_SEED, 0, NUM_TEST, max(HORIZONS), 256)
        with torch.autocast("cpu", torch.bfloat16):
            previous, current = self.encoded(flights)
            states = self.simulator.unroll(previous, current, max(HORIZONS), flights.batch.keys)
        self.simulator.train()
        body, true = flights.body_of(current.positions), flights.displacements
        constant = _best_constant(SCENE)
        found: dict[str, Any] = {"floor_cm": 100 * _mean_length(states[-1].positions - current.positions, body < 0)}
        for step in HORIZONS:
            moved = states[step - 1].positions - current.positions
            errors: dict[str, list[Tensor]] = {
                name: [] for name in ("centre", "nothing_moves", "best_constant", "constant_velocity")
            }
            for number in range(true.shape[2]):
                for member in range(NUM_TEST):
                    own, truth = moved[member][body[member] == number], true[member, step - 1, number]
                    if len(own) < 3:
                        continue
                    guesses = (own.mean(dim=0), 0.0, constant[step - 1], step * flights.velocities[member, number])
                    for name, guess in zip(errors, guesses, strict=True):
                        errors[name].append((guess - truth).norm())
            found[f"step_{step}_cm"] = {name: 100 * float(torch.stack(one).mean()) for name, one in errors.items()}
        if self.row.link != "targets":
            truly = flights.true_displacements(current.positions).unbind(dim=1)
            for name, shown in {
                "predicted": states,
                "nothing_moves": [current] * len(states),
                "truly_moved": [replace(current, positions=current.positions + one) for one in truly],
            }.items():
                found[f"psnr_{name}"] = -10 * math.log10(float(self.pixel_error(shown, flights)))
        return found

    def gradient_cosine(self, num_rays: int) -> float:
        """Return the mean cosine between the pixels' pull on a ball that stands still and its true displacement."""
        cosines = []
        for step in range(12):
            flights = SCENE.flights(TEST_SEED, step, 4, 1, num_rays)
            _, current = self.encoded(flights)
            still = replace(current, positions=current.positions.detach().clone().requires_grad_())
            (pull,) = torch.autograd.grad(-self.pixel_error([still], flights), still.positions)
            body = flights.body_of(current.positions)
            for member, number in ((m, n) for m in range(4) for n in range(2)):
                mine = body[member] == number
                if mine.sum() >= 5:
                    truth = flights.displacements[member, 0, number]
                    cosines.append(torch.cosine_similarity(pull[member][mine].sum(dim=0), truth, dim=0))
        return float(torch.stack(cosines).mean())


def _rate(step: int, num_updates: int) -> float:
    """Return the share of the full learning rate: a warm-up of 50 updates, then a cosine."""
    return min(1.0, (step + 1) / 50) * (0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * step / num_updates)))


@functools.cache
def _best_constant(scene: FreeFlight) -> Tensor:
    """Return the displacement after each step that is the best one for all balls; each row is compared with it."""
    return scene.flights(TEST_SEED + 1, 0, 512, max(HORIZONS), 1).displacements.mean(dim=(0, 2))


def _mean_length(vectors: Tensor, mask: Tensor) -> float:
    return float(vectors.norm(dim=-1)[mask].mean())


def trained(name: str, row: Row, num_updates: int) -> dict[str, Any]:
    """Train and measure one row; returns what is written of it."""
    start = time.process_time()
    training = Training(row, 0, num_updates)
    if row.link in ("ready", "stills"):
        training.learn_to_draw(num_updates)
    curve = {}
    for step in range(num_updates):
        if step % (num_updates // 3) == 0:
            curve[step] = training.measured()
        training.step(step)
    curve[num_updates] = training.measured()
    last = curve[num_updates]
    centre = " / ".join(f"{last[f'step_{step}_cm']['centre']:.1f}" for step in HORIZONS)
    print(f"{name}: {centre} cm after {HORIZONS} steps, {time.process_time() - start:.0f} s", flush=True)
    return {"row": asdict(row), "updates": num_updates, "cpu_seconds": time.process_time() - start, "curve": curve}


def gradients(num_updates: int) -> dict[str, Any]:
    """Return the cosine for each width of kernels and number of rays, and how well such a renderer draws."""
    found = {}
    for scale in (0.05, 0.1, 0.2, 0.3, 0.4):
        training = Training(Row("ready", surface_scale=scale), 0, num_updates)
        training.learn_to_draw(num_updates)
        cosines = {rays: training.gradient_cosine(rays) for rays in (128, 512, 4096)}
        found[str(scale)] = {"cosine": cosines, "psnr": training.measured()["psnr_truly_moved"]}
        print(scale, found[str(scale)], flush=True)
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Train the rows that are not in the file yet."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--rows", nargs="*", default=list(ROWS), choices=list(ROWS))
    parser.add_argument("--updates", type=int, default=600)
    parser.add_argument("--gradients", action="store_true")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    for name in options.rows:
        if name in _read(options.out):
            continue
        _add(options.out, name, trained(name, ROWS[name], options.updates))
    if options.gradients:
        _add(options.out, "gradients", gradients(options.updates // 2))
    return 0


def _read(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text()) if path.is_file() else {}


def _add(path: Path, name: str, value: Any) -> None:
    """Two rows may be trained beside each other: the file is read again before it is written."""
    with AtomicPath(path) as part:
        part.write_text(json.dumps({**_read(path), name: value}, indent=1) + "\n")


if __name__ == "__main__":
    raise SystemExit(main())
