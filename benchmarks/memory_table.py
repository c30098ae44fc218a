"""What a training step keeps in memory, against the number of particles: does 2^17 fit on one 80 GB GPU?

    python -m benchmarks.memory_table [--measure 32768 131072]

What the graph network keeps for its backward pass is counted tensor by tensor (``saved_tensors_hooks``), at the paper's
size with 1,024 abstract nodes and T = 6 steps, on tensors that have shapes but no content; the same count on real
tensors is made once, as a check. ``--measure`` also takes real steps, forward and backward, each in a process of its
own, and notes the most memory that process held. Encoder and renderer are counted on real tensors at a fraction of
their size, in which they are linear.
"""

import argparse
import json
import resource
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch._subclasses.fake_tensor import FakeTensorMode

from benchmarks.worlds import video_batch
from vpd_lightning.config import build_simulator, compose
from vpd_lightning.dynamics.hierarchical_gnn import HierarchicalGNNDynamics, static_step
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.types import Particles, Rays

RESULTS = Path(__file__).parent / "results"
NUM_ABSTRACT, EDGES, NUM_STEPS, FEATURES, GIB = 1024, 150_000, 6, 16, 2**30
SIZES = [2**power for power in range(12, 18)]
RAY_SHARE, RAYS_PER_STEP = 16, 256


def paper_dynamics() -> HierarchicalGNNDynamics:
    """Return the paper's network with room for as many edges as a MuJoCo scene has among 1,024 abstract nodes."""
    return HierarchicalGNNDynamics(
        feature_dim=FEATURES, hidden_dim=128, message_passing_steps=10, num_abstract_nodes=NUM_ABSTRACT,
        max_abstract_neighbors=2, r_s=0.1, r_a_s=0.3, location_scale=0.1, neighbors_backend="auto",
        edge_capacity=EDGES, max_abstract_edges_per_node=None, compile=False,
        feature_limit=1e4, zero_init_decoders=False, normalized_edges=False, edge_gain=1.0, aggregation="sum",
        update_features=True, has_driven=False,
    )  # fmt: skip


def floor_particles(count: int, seed: int) -> Particles:
    """Particles on a bumpy floor of 1.4 m, where 1,024 abstract nodes have about 140,000 edges within 0.3 m."""
    generator = torch.Generator().manual_seed(seed)
    positions = torch.rand(1, count, 3, generator=generator) * 1.4
    positions[..., 2] = 0.02 * (positions[..., 0] * 9).sin() * (positions[..., 1] * 7).cos()
    return Particles(positions, torch.rand(1, count, FEATURES, generator=generator))


@contextmanager
def counting(saved: dict[str, int], stages: dict[str, nn.Module], own: set[int]) -> Iterator[None]:
    """Count the bytes kept for the backward pass, each storage once, on the innermost stage that runs."""
    running, seen, kept = ["other"], set(own), []

    def enter(name: str) -> Any:
        return lambda module, given: running.append(name)

    def leave(module: nn.Module, given: Any, result: Any) -> None:
        running.pop()

    def pack(tensor: Tensor) -> Tensor:
        key = tensor.untyped_storage()._cdata
        if key not in seen:
            seen.add(key)
            kept.append(tensor)  # alive, so that no other storage takes its place
            saved[running[-1]] += tensor.untyped_storage().nbytes()
        return tensor

    handles = [module.register_forward_pre_hook(enter(name)) for name, module in stages.items()]
    handles += [module.register_forward_hook(leave) for module in stages.values()]
    try:
        with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
            yield
    finally:
        for handle in handles:
            handle.remove()


def dynamics_stages(dynamics: HierarchicalGNNDynamics) -> dict[str, nn.Module]:
    """Name the modules that the bytes are booked on."""
    named: dict[str, nn.Module] = {}
    for prefix, group in (("encode", dynamics.encode_node), ("encode edges", dynamics.encode_edge)):
        named |= {f"{prefix} {name}": module for name, module in group.items()}
    for kind, group in (("edges", dynamics.update_edge), ("nodes", dynamics.update_node)):
        for name, module in group.items():
            parts = module if isinstance(module, nn.ModuleList) else [module]
            named |= {f"update {kind} {name} {number}": part for number, part in enumerate(parts)}
    return named | {"decode location": dynamics.decode_location, "decode feature": dynamics.decode_feature}


def kept_by_a_step(num_particles: int, is_bf16: bool, is_fake: bool) -> dict[str, int]:
    """Return the bytes that one step of the dynamics keeps, by what keeps them."""
    saved: dict[str, int] = defaultdict(int)
    dynamics = paper_dynamics()
    with FakeTensorMode(allow_non_fake_inputs=True) if is_fake else nullcontext():
        if is_fake:
            count = (1, num_particles)
            given = [
                (torch.empty(*count, 3, requires_grad=True), torch.empty(*count, FEATURES, requires_grad=True),
                 torch.ones(count, dtype=torch.bool)) for _ in range(2)
            ]  # fmt: skip
        else:
            scene = [floor_particles(num_particles, seed) for seed in range(2)]
            given = [(one.positions.requires_grad_(), one.features.requires_grad_(), one.mask) for one in scene]
        priorities = torch.rand(1, num_particles, dtype=torch.float64)
        own = {parameter.untyped_storage()._cdata for parameter in dynamics.parameters()}
        with counting(saved, dynamics_stages(dynamics), own), torch.autocast("cpu", torch.bfloat16, enabled=is_bf16):
            static_step(dynamics, NUM_ABSTRACT, priorities, *given)
    grouped: dict[str, int] = defaultdict(int)
    for name, size in saved.items():
        group = "message passing" if "abstract_to_abstract" in name or "nodes abstract " in name else name.split()[0]
        grouped["particle edges and nodes" if group in ("encode", "update") else group] += size
    return dict(grouped)


def kept_elsewhere() -> dict[str, int]:
    """Return what encoder (one view) and renderer (all rays of six steps) keep, from a real fraction of the rays."""
    simulator = build_simulator(compose("train", ["experiment=mujoco_block"])).train()
    batch = video_batch(128, 1, RAYS_PER_STEP // RAY_SHARE)
    own = {parameter.untyped_storage()._cdata for parameter in simulator.parameters()}
    sizes: dict[str, int] = defaultdict(int)
    with counting(sizes, {"encoder": simulator.encoder}, own):
        simulator.encoder(batch.context[:, 1], batch.keys, "current")
    particles = floor_particles(2**12, 0)
    with counting(sizes, {"renderer": simulator.renderer}, own):
        origins, directions = (field[:, 0] for field in (batch.rays.origins, batch.rays.directions))
        simulator.renderer(Particles(particles.positions, particles.features), Rays(origins, directions), batch.keys)
    return {"encoder": sizes["encoder"], "renderer": sizes["renderer"] * RAY_SHARE * NUM_STEPS}


def table_rows(elsewhere: dict[str, int]) -> list[dict[str, Any]]:
    """Return one row per number of particles and configuration: GiB of each part of a training step."""
    parameters = sum(parameter.numel() for parameter in paper_dynamics().parameters())
    rows = []
    for is_bf16 in (False, True):
        for count in SIZES:
            parts = kept_by_a_step(count, is_bf16, is_fake=True)
            step = sum(parts.values())
            carried_on = NUM_STEPS * count * (3 + FEATURES) * 4
            # In the backward pass of an edge update four tensors as large as the largest edges live at once.
            workspace = 4 * max(EDGES, 2 * count) * 128 * 4
            # Two context frames; a view of 128 x 128 pixels gives 2^14 particles.
            outside = 2 * elsewhere["encoder"] * max(1, count // 2**14) + elsewhere["renderer"]
            for is_checkpointed in (False, True):
                dynamics = (step if is_checkpointed else NUM_STEPS * step) + carried_on
                # Weights, gradients, two moments of Adam for the whole model (9.8 million parameters).
                fixed = 4 * 4 * (9_762_155 - 1_612_435 + parameters)
                rows.append(
                    {
                        "particles": count, "bf16": is_bf16, "checkpoint_dynamics": is_checkpointed,
                        "one_step": step, "one_step_parts": parts, "dynamics": dynamics, "workspace": workspace,
                        "encoder_and_renderer": outside, "weights_and_optimizer": fixed,
                        "total": dynamics + workspace + outside + fixed,
                    }
                )  # fmt: skip
    return rows


def _peak_bytes() -> int:
    """Return the most memory this process has held so far (Linux counts kibibytes, macOS bytes)."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def measured_step(num_particles: int) -> dict[str, Any]:
    """Take one real step, forward and backward, and return the memory and the processor time it took."""
    torch.set_num_threads(1)
    dynamics = paper_dynamics()
    dynamics.edge_capacity = None
    previous, current = floor_particles(num_particles, 0), floor_particles(num_particles, 1)
    start = time.process_time()
    following, _ = dynamics(previous, current, None, RandomKeys(0, 0, [0]), 0)
    (following.positions.sum() + following.features.sum()).backward()
    seconds = time.process_time() - start
    return {"particles": num_particles, "peak": _peak_bytes(), "processor_seconds": seconds}


def markdown(rows: list[dict[str, Any]]) -> str:
    """Return the rows as a Markdown table in GiB."""
    columns = ("one_step", "dynamics", "workspace", "encoder_and_renderer", "weights_and_optimizer", "total")
    lines = [
        "| particles | precision | checkpointed | " + " | ".join(name.replace("_", " ") for name in columns) + " |"
    ]
    lines.append("|---:|---|---|" + "---:|" * len(columns))
    for item in rows:
        kind = "bf16" if item["bf16"] else "float32"
        sizes = " | ".join(f"{item[name] / GIB:.2f}" for name in columns)
        lines.append(f"| {item['particles']:,} | {kind} | {'yes' if item['checkpoint_dynamics'] else 'no'} | {sizes} |")
    return "\n".join(lines)


def main() -> int:
    """Print the table and write it to results/memory_cpu.json; 1 if 2^17 particles do not fit into 80 GB."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--measure", type=int, nargs="*", default=[], help="numbers of particles to take a step with")
    parser.add_argument("--one", type=int, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.one:
        print(json.dumps(measured_step(arguments.one)))
        return 0
    # First, while this process is small: a child starts with its parent's peak on Linux.
    measured = []
    for count in arguments.measure:
        command = [sys.executable, "-m", "benchmarks.memory_table", "--one", str(count)]
        measured.append(json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout))
        print(f"measured at {count} particles: peak {measured[-1]['peak'] / GIB:.2f} GiB, {measured[-1]}")
    check = {kind: sum(kept_by_a_step(SIZES[0], False, kind == "fake").values()) for kind in ("fake", "real")}
    elsewhere = kept_elsewhere()
    rows = table_rows(elsewhere)
    print(
        f"GiB kept for one training step of one clip, {NUM_STEPS} steps, {NUM_ABSTRACT} abstract nodes, {EDGES} edges"
    )
    print(f"\n{markdown(rows)}\n\ncounted at {SIZES[0]} particles: {check}")
    content = {
        "suite": "memory", "versions": {"torch": torch.__version__},
        "num_steps": NUM_STEPS, "num_abstract_nodes": NUM_ABSTRACT, "edges": EDGES, "check": check,
        "elsewhere": elsewhere, "rows": rows, "measured": measured,
    }  # fmt: skip
    path = RESULTS / "memory_cpu.json"
    path.write_text(json.dumps(content, indent=1) + "\n")
    print(path)
    largest = [item["total"] for item in rows if item["particles"] == SIZES[-1] and item["checkpoint_dynamics"]]
    return int(max(largest) > 80e9)


if __name__ == "__main__":
    sys.exit(main())
