"""One training step, by stage, against the plain path: ``python -m benchmarks.train_step [--size demo mid]``.

Both paths take turns on the same weights and the same batch; the figures are medians. That they give the same
gradients is checked; ``error`` is their relative difference.
"""

import argparse
import tempfile
from collections import defaultdict
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.measuring import Row, Stopwatch, replaced, row, write
from benchmarks.plain_path import plain
from benchmarks.workloads import WORKLOADS, Training, Workload, prepare
from vpd_lightning.dynamics import hierarchical_gnn
from vpd_lightning.graph.neighbors import PointIndex

STAGES = ("encode", "graph", "dynamics", "render", "loss", "backward", "optimiser")
TOLERANCE = 1e-2  # relative, of all gradients: float32 sums in another order, through a rollout of several steps


@contextmanager
def watched(training: Training, watch: Stopwatch) -> Iterator[None]:
    """Book encoder, dynamics, graph and renderer of a forward pass on the stopwatch."""
    simulator = training.simulator
    with ExitStack() as stack:
        stages = {"encode": simulator.encoder, "dynamics": simulator.dynamics, "render": simulator.renderer}
        for name, stage in stages.items():
            stack.enter_context(replaced(stage, "forward", watch.timed(stage.forward, name, inside="other")))
        initialize = watch.timed(simulator.dynamics.initialize, "dynamics", inside="other")
        stack.enter_context(replaced(simulator.dynamics, "initialize", initialize))
        graph = watch.timed(hierarchical_gnn.build_graph, "graph", inside="dynamics")
        stack.enter_context(replaced(hierarchical_gnn, "build_graph", graph))
        for search in ("knn", "radius"):
            timed = watch.timed(getattr(PointIndex, search), "graph", inside="dynamics")
            stack.enter_context(replaced(PointIndex, search, timed))
        yield


def step(training: Training, watch: Stopwatch) -> Tensor:
    """Take one training step without changing the weights; return all gradients in one vector."""
    training.optimizer.zero_grad(set_to_none=True)
    with watch.stage("other"):
        output = training.simulator(training.batch)
    with watch.stage("loss"):
        loss = torch.stack([term.weight * term(output, training.batch) for term in training.losses]).sum()
    with watch.stage("backward"):
        loss.backward()
    rates = [group["lr"] for group in training.optimizer.param_groups]
    for group in training.optimizer.param_groups:
        group["lr"] = 0.0  # all the work, no change: every repetition sees the same numbers
    with watch.stage("optimiser"):
        training.optimizer.step()
    for group, rate in zip(training.optimizer.param_groups, rates, strict=True):
        group["lr"] = rate
    gradients = [p.grad.flatten() for p in training.simulator.parameters() if p.grad is not None]
    return torch.cat(gradients).double()


def measure(workload: Workload, scratch: Path, device: torch.device, repeats: int) -> list[Row]:
    """Return the rows of one size: the whole step, then its stages."""
    training = prepare(workload, scratch, device)
    num_steps = training.batch.rgbs.shape[1]
    seconds: dict[str, dict[str, list[float]]] = {"fast": defaultdict(list), "plain": defaultdict(list)}
    gradients: dict[str, Tensor] = {}
    peak = None
    for repeat in range(repeats + 1):  # the first round warms up
        for path in ("fast", "plain"):
            watch = Stopwatch(device)
            if device.type == "cuda":
                torch.cuda.reset_peak_memory_stats(device)
            with plain(training.simulator, num_steps) if path == "plain" else nullcontext(), watched(training, watch):
                gradients[path] = step(training, watch)
            if device.type == "cuda" and path == "fast":
                peak = torch.cuda.max_memory_allocated(device)
            if repeat:
                for name in (*STAGES, "other"):
                    seconds[path][name].append(watch.seconds.get(name, 0.0))
                seconds[path]["step"].append(sum(watch.seconds.values()))
    error = float((gradients["fast"] - gradients["plain"]).norm() / gradients["plain"].norm())
    if not error < TOLERANCE:
        raise AssertionError(f"{workload.name}: the two paths disagree, relative difference of gradients {error:.1e}")
    note = f"batch {len(training.batch.rgbs)}, {num_steps} steps, {training.batch.rgbs.shape[2]} rays per step"
    name = f"train_step/{workload.name}"
    rows = [row(name, seconds["fast"]["step"], "plain path", seconds["plain"]["step"], error, peak, note)]
    for stage in (*STAGES, "other"):
        if max(seconds["fast"][stage]) > 0 or max(seconds["plain"][stage]) > 0:
            rows.append(row(f"{name}/{stage}", seconds["fast"][stage], "plain path", seconds["plain"][stage]))
    return rows


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", nargs="+", choices=sorted(WORKLOADS), default=["demo", "demo_paper_stages", "mid"])
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args()
    device = torch.device(options.device)
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as scratch:
        for size in options.size:
            rows += measure(WORKLOADS[size], Path(scratch), device, options.repeats)
    write("train_step", device, [*rows, *_demo_against_paper(rows)])


def _demo_against_paper(rows: list[Row]) -> list[Row]:
    """Set the demo beside the plain path of the paper's stages on the same data, where both were measured."""
    found = {item.name: item for item in rows}
    demo, paper = found.get("train_step/demo"), found.get("train_step/demo_paper_stages")
    if demo is None or paper is None or paper.baseline_seconds is None:
        return []
    name, baseline = "train_step/demo, once more", "demo_paper_stages, plain path"
    return [row(name, [demo.seconds], baseline, [paper.baseline_seconds], note="another model on the same batch")]


if __name__ == "__main__":
    main()
