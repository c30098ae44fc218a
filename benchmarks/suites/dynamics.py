"""The graph network: a step against the plain one, its graph's share, factored edges, and sleeping."""

from copy import deepcopy
from pathlib import Path

import torch
from torch import Tensor

from benchmarks import plots, stages
from benchmarks.arithmetic import dynamics_layers, edge_counts, work
from benchmarks.measuring import (
    Options,
    Result,
    Row,
    Stopwatch,
    copy_rate,
    device_peak,
    gemm_rate,
    interleaved,
    replaced,
    row,
)  # fmt: skip
from benchmarks.plain import dynamics as plain
from benchmarks.worlds import two_frames
from vpd_lightning.dynamics import hierarchical_gnn
from vpd_lightning.dynamics.blocks import EdgeUpdater
from vpd_lightning.dynamics.hierarchical_gnn import HierarchicalGNNDynamics
from vpd_lightning.graph.hierarchical import EdgeSet
from vpd_lightning.graph.incidence import Incidence
from vpd_lightning.randomness import RandomKeys

KEYS = RandomKeys.fixed(1)
TINY = {"hidden_dim": 16, "message_passing_steps": 2, "num_abstract_nodes": 8, "r_s": 0.5, "r_a_s": 1.0}


def build(options: Options, **changes: object) -> HierarchicalGNNDynamics:
    """Build the paper's dynamics (narrow in ``tiny``)."""
    torch.manual_seed(0)
    values = {**options.pick({}, {"num_abstract_nodes": 512}, TINY), **changes}
    return stages.build("dynamics/hierarchical_gnn", "mujoco", **values).to(options.device).eval()


def run(options: Options) -> Result:
    """Measure a step at inference and in training, the edge layer alone, and what sleeping saves."""
    device = options.device
    model = build(options)
    previous, current = (p.to(device) for p in two_frames(options.pick(16384, 4096, 64)))

    def fast() -> Tensor:
        with torch.no_grad():
            return model(previous, current, None, KEYS, 0)[0].positions

    def written_plainly() -> Tensor:
        with torch.no_grad():
            return plain.advance(model, previous, current, None, KEYS, 0)[0].positions

    def training() -> None:
        model.zero_grad(set_to_none=True)
        after, _ = model(previous, current, None, KEYS, 0)
        (after.positions.square().sum() + after.features.square().sum()).backward()

    def plain_training() -> None:
        model.zero_grad(set_to_none=True)
        after, _ = plain.advance(model, previous, current, None, KEYS, 0)
        (after.positions.square().sum() + after.features.square().sum()).backward()

    double = deepcopy(model).double()
    with torch.no_grad():
        states = (p.to(torch.float64) for p in (previous, current))
        truth = plain.advance(double, *states, None, KEYS, 0)[0].positions
    functions = {"fast": fast, "plain": written_plainly, "training": training, "plain training": plain_training}
    seconds = interleaved(functions, options.repeats, device)
    counts = edge_counts(model, previous, current)
    note = (
        f"{counts.current} particles, {counts.abstract} abstract nodes, {counts.abstract_to_abstract} edges among them"
    )
    error = float((fast().double() - truth).abs().max())
    rows = [
        row(
            "step/inference", seconds["fast"], "plain", seconds["plain"], error,
            peak_bytes=device_peak(fast, device), note=f"{note}; error in metres to float64",
        ),
        row(
            "step/training", seconds["training"], "plain", seconds["plain training"],
            peak_bytes=device_peak(training, device), note="forward and backward",
        ),
    ]  # fmt: skip
    share, graph_row = _graph_share(model, previous, current, options)
    rows += [graph_row, *_edge_layer(model, counts.abstract, counts.abstract_to_abstract, options), *_sleeping(options)]
    operations, moved = gemm_rate(device), copy_rate(device)
    factored, concatenated = (work(dynamics_layers(model, counts, is_plain)) for is_plain in (False, True))
    facts = {
        "graph_share_of_step": share,
        "operations": factored.operations,
        "operations_concatenated": concatenated.operations,
        "bytes": factored.bytes,
        "gemm_operations_per_second": operations,
        "copied_bytes_per_second": moved,
        "floor_share": factored.seconds(operations, moved) / (rows[0].seconds or 1.0),
    }
    return Result(rows, facts)


def _graph_share(model: HierarchicalGNNDynamics, previous, current, options: Options) -> tuple[float, Row]:
    """Time the building of the graph within steps."""
    graph, rest = [], []
    for repeat in range(options.repeats + 1):
        watch = Stopwatch(options.device)
        timed = watch.timed(hierarchical_gnn.build_graph, "graph", inside="step")
        with torch.no_grad(), replaced(hierarchical_gnn, "build_graph", timed), watch.stage("step"):
            model(previous, current, None, KEYS, 0)
        if repeat:
            graph.append(watch.seconds["graph"])
            rest.append(sum(watch.seconds.values()))
    result = row("graph/of a step", graph, "whole step", rest, note="neighbours, sorting, offsets")
    return (result.seconds or 0.0) / (result.baseline_seconds or 1.0), result


def _edge_layer(model: HierarchicalGNNDynamics, num_nodes: int, num_edges: int, options: Options) -> list[Row]:
    """One edge update among abstract nodes: factored against concatenated, forward and backward."""
    update: EdgeUpdater = model.update_edge["abstract_to_abstract"][0]
    width = update.norm.normalized_shape[0]
    generator = torch.Generator().manual_seed(0)
    edges, nodes = (
        torch.randn(count, width, generator=generator).to(options.device) for count in (num_edges, num_nodes)
    )
    senders, receivers = (
        torch.randint(0, num_nodes, (num_edges,), generator=generator).to(options.device) for _ in range(2)
    )

    receivers = receivers.sort().values
    edge_set = EdgeSet(Incidence.of(senders, num_nodes), Incidence.of(receivers, num_nodes, is_sorted=True))

    def factored() -> Tensor:
        return update(edges, nodes, nodes, edge_set)

    def concatenated() -> Tensor:
        together = torch.cat([edges, nodes[senders], nodes[receivers]], dim=-1)
        return edges + update.norm(update.mlp(together))

    error = float((factored() - concatenated()).detach().abs().max())
    seconds = interleaved(
        {"factored": lambda: factored().sum().backward(), "concatenated": lambda: concatenated().sum().backward()},
        options.repeats,
        options.device,
    )
    note = f"{num_edges} edges, forward and backward; largest difference"
    return [row("edge layer/factored", seconds["factored"], "concatenated", seconds["concatenated"], error, note=note)]


def _sleeping(options: Options) -> list[Row]:
    """Steps by the share of particles that is awake, and rollouts of the checkpoints with sleeping and without."""
    if options.size == "tiny" or options.device.type != "cpu":
        return []
    from benchmarks import sleeping  # needs Hydra and Lightning

    rows = list(sleeping.step_costs(options.pick(16384, 4096, 64), (1.0, 0.5, 0.2, 0.0), options.repeats))
    for path in options.checkpoints:
        steps = options.pick(32, 8, 1)
        found = sleeping.compare(path, "test", options.pick(2, 1, 1), [steps], data=options.data)
        rows += sleeping.as_rows(path.parent.parent.name, found)
    return rows


def draw(result: Result, path: Path) -> None:
    """Draw all rows."""
    plots.bars(result.rows, "Dynamics", path)
