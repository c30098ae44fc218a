"""One training step at any size, in the variants that are compared: the same weights, batch and draws in all."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from benchmarks import stages
from benchmarks.measuring import Stopwatch, replaced
from benchmarks.plain.literal import LiteralVPD
from benchmarks.plain.simulator import plain
from benchmarks.worlds import video_batch
from vpd_lightning.dynamics import hierarchical_gnn
from vpd_lightning.losses.pixel import PixelLoss
from vpd_lightning.simulator import Simulator
from vpd_lightning.training.optimization import StepDecayAdam
from vpd_lightning.types import VideoBatch

_LITERAL_DYNAMICS = {"hidden": "hidden_dim", "num_rounds": "message_passing_steps", "r_s": "r_s", "r_a_s": "r_a_s"}
_LITERAL_RENDERER = {
    "num_coarse": "num_coarse_samples", "num_fine": "num_fine_samples", "field_width": "net_width",
    "condition_width": "net_width_condition", "num_neighbors": "num_neighbors",
}  # fmt: skip
STAGES = ("encode", "graph", "dynamics", "render", "loss", "backward", "optimiser")


@dataclass(frozen=True)
class Scale:
    """The shapes of a step: one clip of one view, networks of the named options with the given changes."""

    image: int
    particles: int
    abstract_nodes: int
    steps: int
    rays: int
    encoder: str = "unet"
    dynamics: Mapping[str, Any] | None = None
    renderer: Mapping[str, Any] | None = None


# Networks as in the paper everywhere but in `tiny`.
PAPER = Scale(128, 16384, 1024, 6, 256)
HOUSE = Scale(128, 2048, 256, 2, 64)
QUICK = Scale(64, 1024, 128, 2, 32, renderer={"num_coarse_samples": 32, "num_fine_samples": 64})
TINY = Scale(
    32, 64, 8, 2, 8, "unet_small",
    {"hidden_dim": 16, "message_passing_steps": 2, "r_s": 0.5, "r_a_s": 1.0},
    {"num_coarse_samples": 8, "num_fine_samples": 8, "net_width": 16, "net_width_condition": 8, "num_neighbors": 4},
)  # fmt: skip

OTHER_RENDERERS = ("surface", "splat")  # another loss than the paper's renderer, so other gradients
EDGES_PER_NODE = 256  # room for edges among abstract nodes where shapes are fixed; surfaces have 90 to 160


class LiteralStep:
    """A training step of ``plain.literal`` on the input of ``Step``; only its time and its memory can be compared."""

    def __init__(self, scale: Scale, device: torch.device) -> None:
        torch.manual_seed(0)
        self.device = device
        dynamics, renderer = scale.dynamics or {}, scale.renderer or {}
        given = {name: dynamics[key] for name, key in _LITERAL_DYNAMICS.items() if key in dynamics}
        given |= {name: renderer[key] for name, key in _LITERAL_RENDERER.items() if key in renderer}
        widths = stages.section(f"encoder/{scale.encoder}")["channels"][:-1]
        self.model = LiteralVPD((*widths, 16), scale.particles, scale.abstract_nodes, **given).to(device).train()
        self.batch: VideoBatch = video_batch(scale.image, scale.steps, scale.rays).to(device)
        self.optimizer = torch.optim.Adam(self.model.parameters(), lr=0.0)
        self.last_loss = float("nan")

    def __call__(self, watch: Stopwatch | None = None) -> None:
        """Take the step."""
        watch = watch or Stopwatch(self.device)
        self.optimizer.zero_grad(set_to_none=True)
        with watch.stage("forward"):
            loss = self.model(self.batch)
        with watch.stage("backward"):
            loss.backward()
        with watch.stage("optimiser"):
            self.optimizer.step()
        self.last_loss = float(loss.detach())


class Step:
    """A training step of one variant.

    ``fast`` is our path with everything kept for the backward pass; ``plain`` the same weights on the plain path;
    ``saving`` computes activations again instead of keeping them; ``bf16`` multiplies in bfloat16; ``surface`` and
    ``splat`` have those renderers, with ``_bf16`` in bfloat16; ``compiled`` gives the dynamics fixed shapes and, on a
    GPU, hands it to torch.compile (a CUDA graph), in bfloat16.
    """

    def __init__(self, variant: str, scale: Scale, device: torch.device) -> None:
        self.variant, self.scale, self.device = variant, scale, device
        self.simulator = build_simulator(variant, scale, device.type == "cuda").to(device).train()
        self.batch: VideoBatch = video_batch(scale.image, scale.steps, scale.rays).to(device)
        self.loss = PixelLoss(weight=1.0, coarse_weight=1.0)
        # A rate too low to change a weight: all the work, and every repetition sees the same weights.
        adam = StepDecayAdam(lr=1e-30, betas=[0.9, 0.999], eps=1e-8, milestones=[], gamma=1.0)
        self.optimizer = adam.build(self.simulator, max_steps=1)[0]
        self.last_loss = float("nan")

    def __call__(self, watch: Stopwatch | None = None) -> None:
        """Take the step."""
        watch = watch or Stopwatch(self.device)
        with ExitStack() as stack:
            if self.variant == "plain":
                stack.enter_context(plain(self.simulator, self.scale.steps))
            stack.enter_context(watched(self.simulator, watch))
            self.optimizer.zero_grad(set_to_none=True)
            is_bf16 = self.variant.endswith("bf16") or self.variant == "compiled"
            with torch.autocast(self.device.type, torch.bfloat16) if is_bf16 else nullcontext():
                with watch.stage("other"):
                    output = self.simulator(self.batch)
                with watch.stage("loss"):
                    loss = self.loss(output, self.batch)
            with watch.stage("backward"):
                loss.backward()
            with watch.stage("optimiser"):
                self.optimizer.step()
        self.last_loss = float(loss.detach())

    def gradients(self) -> Tensor:
        """Return all gradients of the last step in one vector."""
        return torch.cat([p.grad.flatten() for p in self.simulator.parameters() if p.grad is not None]).double()


def build_simulator(variant: str, scale: Scale, is_gpu: bool) -> Simulator:
    """Build the simulator of a variant; variants with the same networks have the same weights."""
    dynamics = {"num_abstract_nodes": scale.abstract_nodes, **(scale.dynamics or {})}
    option, renderer = "point_nerf", dict(scale.renderer or {})
    saves = variant == "saving"
    if variant.startswith(OTHER_RENDERERS):
        option, renderer = variant.removesuffix("_bf16"), {}
    else:
        renderer["checkpoint_chunks"] = saves
    if variant == "compiled":
        dynamics |= {"edge_capacity": EDGES_PER_NODE * scale.abstract_nodes, "compile": is_gpu}
    return stages.build_simulator(
        "mujoco",
        (scale.encoder, {"num_particles": scale.particles}),
        ("hierarchical_gnn", dynamics),
        (option, renderer),
        checkpoint_dynamics=saves,
        pixel_gradient_to_motion=1.0,
    )


@contextmanager
def watched(simulator: Simulator, watch: Stopwatch) -> Iterator[None]:
    """Book encoder, dynamics, graph and renderer of a forward pass on the stopwatch."""
    with ExitStack() as stack:
        parts = {"encode": simulator.encoder, "dynamics": simulator.dynamics, "render": simulator.renderer}
        for name, part in parts.items():
            stack.enter_context(replaced(part, "forward", watch.timed(part.forward, name, inside="other")))
        graph = watch.timed(hierarchical_gnn.build_graph, "graph", inside="dynamics")
        stack.enter_context(replaced(hierarchical_gnn, "build_graph", graph))
        yield


def prepared(variant: str, scale: str) -> Callable[[], Any]:
    """Return a step whose memory is to be measured (see ``memory_probe``)."""
    step = Step(variant, SCALES[scale], torch.device("cpu"))

    def call() -> float:
        step()
        return step.last_loss

    return call


SCALES = {"paper": PAPER, "full": HOUSE, "quick": QUICK, "tiny": TINY}
