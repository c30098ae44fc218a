"""One real training step at the paper's full size (``experiment=mujoco_block``) on synthetic RGB-D: time and memory.

    python -m benchmarks.paper_size_step [--json FILE] [OVERRIDE ...]

One sample, one input view of 128x128 (2^14 particles, all in the workspace), 1,024 abstract nodes, T = 6 steps of 256
rays, 128 + 256 samples per ray. Every parameter must receive a finite gradient, and the peak memory of the process
must stay below 16 GiB; the exit code is 1 otherwise. Overrides are those of vpd-train, for example
``renderer.ray_chunk_size=64``.
"""

import argparse
import json
import resource
import sys
import time
from pathlib import Path
from typing import Any

import torch
from torch import nn

from benchmarks.worlds import video_batch
from vpd_lightning.config import build, build_list, build_simulator, compose
from vpd_lightning.losses.base import AbstractLoss
from vpd_lightning.training.optimization import AbstractOptimization

SIZE = 128
NUM_STEPS, RAYS_PER_STEP = 6, 256
LIMIT_BYTES = 16 * 2**30


def count_parameters(module: nn.Module) -> int:
    """Return the number of trainable values."""
    return sum(parameter.numel() for parameter in module.parameters() if parameter.requires_grad)


def _peak_bytes() -> int:
    """Return the most memory this process has held so far (Linux counts kibibytes, macOS bytes)."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def run_step(overrides: list[str]) -> dict[str, Any]:
    """Compose, build, and take one training step; return counts, seconds, memory and what is wrong with gradients."""
    config = compose("train", ["experiment=mujoco_block", *overrides])
    torch.manual_seed(0)
    simulator = build_simulator(config).train()
    losses = build_list(config["loss"], AbstractLoss, "loss")
    optimizer, _ = build(config["optimizer"], AbstractOptimization, "optimizer").build(simulator, 400_000)
    batch = video_batch(SIZE, NUM_STEPS, RAYS_PER_STEP)
    before = {name: parameter.detach().clone() for name, parameter in simulator.named_parameters()}
    peak_before, start, processor_start = _peak_bytes(), time.perf_counter(), time.process_time()
    output = simulator(batch)
    loss = sum(part.weight * part(output, batch) for part in losses)
    forward = time.perf_counter()
    loss.backward()
    backward = time.perf_counter()
    gradients = {name: parameter.grad for name, parameter in simulator.named_parameters()}
    optimizer.step()
    end, processor_time = time.perf_counter(), time.process_time() - processor_start
    return {
        "suite": "paper_size_step",
        "versions": {"torch": torch.__version__, "threads": torch.get_num_threads()},
        "particles": int(output.states[0].mask.sum()),
        "parameters": {
            **{name: count_parameters(stage) for name, stage in simulator.named_children()},
            **{f"renderer.{name}": count_parameters(stage) for name, stage in simulator.renderer.named_children()},
            "total": count_parameters(simulator),
        },
        "loss": float(loss.detach()),
        "seconds": {
            "forward": forward - start,
            "backward": backward - forward,
            "optimizer": end - backward,
            "total": end - start,
            "processor": processor_time,
        },
        "peak_bytes": _peak_bytes(),
        "peak_bytes_before_the_step": peak_before,
        "without_gradient": [name for name, gradient in gradients.items() if gradient is None],
        "non_finite_gradient": [n for n, g in gradients.items() if g is not None and not bool(g.isfinite().all())],
        "zero_gradient": [name for name, g in gradients.items() if g is not None and not bool(g.any())],
        "not_updated": [n for n, p in simulator.named_parameters() if torch.equal(before[n], p.detach())],
    }


def main() -> int:
    """Print the report; 0 if the step is what the paper's size asks for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="also write the figures here")
    parser.add_argument("overrides", nargs="*", help="as for vpd-train")
    arguments = parser.parse_args()
    report = run_step(arguments.overrides)
    for name, count in report["parameters"].items():
        print(f"{name:20s} {count:>12,} parameters")
    print(f"particles {report['particles']}, loss {report['loss']:.5f}")
    print(", ".join(f"{name} {seconds:.1f} s" for name, seconds in report["seconds"].items()))
    print(f"peak memory {report['peak_bytes'] / 2**30:.2f} GiB (limit {LIMIT_BYTES / 2**30:.0f} GiB)")
    faults = [key for key in ("without_gradient", "non_finite_gradient") if report[key]]
    for key in (*faults, "zero_gradient"):
        print(f"{key}: {', '.join(report[key]) or 'none'}")
    if arguments.json:
        arguments.json.write_text(json.dumps(report, indent=2) + "\n")
        print(arguments.json)
    return int(bool(faults) or report["peak_bytes"] > LIMIT_BYTES or report["particles"] != SIZE * SIZE)


if __name__ == "__main__":
    sys.exit(main())
