"""Nearest neighbours: every backend that is there against SciPy with all workers and torch-cluster, in the same run."""

import importlib.util
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from benchmarks import plots
from benchmarks.measuring import Options, Result, Row, interleaved, num_threads, row
from benchmarks.worlds import picture_rays, surface_particles
from vpd_lightning.graph.neighbors import BACKENDS, PointIndex

K = 16
FAR = 5.0
# Of the bounded search: a radius + 3.1 bandwidths of the paper's widest MuJoCo kernel, and beyond those of the others.
MAX_RADII = (2.06, 0.3)


def run(options: Options) -> Result:
    """Measure the renderer's search, unbounded and within a radius, and the searches of the dynamics' graph."""
    device = options.device
    num_points = options.pick(16384, 4096, 256)
    num_rays, num_samples = options.pick((1536, 384), (256, 192), (8, 16))
    points = surface_particles(num_points).positions[0].to(device)
    queries = ray_samples(num_rays, num_samples).to(device)
    sizes = f"{num_points} particles, {len(queries)} samples on rays"
    truth = _float64_distances(points, queries)
    rows = _searches(points, queries, None, truth, options, sizes)
    for radius in MAX_RADII:
        rows += _searches(points, queries, radius, truth, options, f"{sizes}, none farther than {radius} m")
    return Result(rows + _graph(options), {"points": num_points, "queries": len(queries), "k": K})


def ray_samples(num_rays: int, num_samples: int) -> Tensor:
    """Return evenly spaced sample points on random rays of a picture, ray by ray."""
    rays = picture_rays(128, num_rays)
    t = torch.linspace(0.3, FAR, num_samples)
    return (rays.origins[0][:, None] + t[:, None] * rays.directions[0][:, None]).flatten(0, 1)


def peers(points: Tensor, queries: Tensor, k: int, max_radius: float | None) -> dict[str, Callable[[], Tensor]]:
    """Return other people's searches, each giving distances (query, k); building their tree is part of the work."""
    found: dict[str, Callable[[], Tensor]] = {}
    if points.device.type == "cpu":
        from scipy.spatial import cKDTree

        def scipy_tree() -> Tensor:
            bound = np.inf if max_radius is None else max_radius
            distance, _ = cKDTree(points.numpy()).query(queries.numpy(), k, distance_upper_bound=bound, workers=-1)
            return torch.from_numpy(distance)

        found["SciPy, all workers"] = scipy_tree
    if importlib.util.find_spec("torch_cluster") is not None:
        import torch_cluster

        def cluster() -> Tensor:
            index = torch_cluster.knn(points, queries, k)[1].view(len(queries), k)
            return (points[index] - queries[:, None]).square().sum(dim=-1).sqrt()

        found["torch-cluster"] = cluster
    return found


def backends(device: torch.device, num_points: int) -> list[str]:
    """Return our backends that this machine has; brute force only where it ends before lunch."""
    needs = {"scipy": "scipy", "torch_cluster": "torch_cluster", "numba": "numba", "triton": "triton"}
    names = [name for name in BACKENDS if name not in needs or importlib.util.find_spec(needs[name]) is not None]
    if device.type == "cpu":
        interpreted = os.environ.get("TRITON_INTERPRET") == "1" and num_points <= 256
        left_out = {name for name, is_slow in (("triton", not interpreted), ("torch", num_points > 4096)) if is_slow}
        return [name for name in names if name not in left_out]
    return [name for name in names if name in ("torch", "triton", "torch_cluster")]


def _searches(
    points: Tensor, queries: Tensor, max_radius: float | None, truth: Tensor, options: Options, note: str
) -> list[Row]:
    """Ours with one thread, as everything here; SciPy's workers are not bound by that."""
    found = peers(points, queries, K, max_radius)
    names = ["auto", *backends(options.device, len(points))]

    def ours(name: str) -> Callable[[], Tensor]:
        return lambda: PointIndex(points, name).knn(queries, K, max_radius).distance

    functions = {**found, **{name: ours(name) for name in names}}
    errors = {name: _error(function(), truth, max_radius) for name, function in functions.items()}
    seconds = {name: [] for name in functions}
    with num_threads(options.pick(_cores(), _cores(), 1)):  # all searches may use all cores, so the clock is the wall's
        seconds = interleaved(functions, options.repeats, options.device, warm_up=False)  # the errors were one
    kind = "knn" if max_radius is None else f"knn within {max_radius} m"
    rows = [row(f"{kind}/{name}", seconds[name], error=errors[name], note=note) for name in found]
    peer_names = list(found) or ["torch"]
    for name in names:
        for peer in peer_names if name == "auto" else peer_names[:1]:
            there = () if peer == name else seconds[peer]
            rows.append(
                row(f"{kind}/{name}", seconds[name], "" if peer == name else peer, there, errors[name], note=note)
            )
    return rows


def _graph(options: Options) -> list[Row]:
    """Ties of particles of two times to their two nearest abstract nodes, and all pairs of abstract nodes in reach."""
    count, abstract = options.pick((16384, 1024), (4096, 512), (64, 8))
    particles = surface_particles(2 * count).positions[0].to(options.device)
    nodes = particles[torch.randperm(len(particles), generator=torch.Generator().manual_seed(0))[:abstract]]

    def ours() -> None:
        PointIndex(nodes, "auto").knn(particles, 2, 0.1)
        PointIndex(nodes, "auto", is_radius=True).radius(nodes, 0.3)

    def reference() -> None:
        PointIndex(nodes, "torch").knn(particles, 2, 0.1)
        PointIndex(nodes, "torch", is_radius=True).radius(nodes, 0.3)

    seconds = interleaved({"ours": ours, "reference": reference}, options.repeats, options.device)
    note = f"2 of {abstract} nodes for {len(particles)} particles, and all pairs of nodes within 0.3 m"
    return [row("graph/auto", seconds["ours"], "torch (brute force)", seconds["reference"], note=note)]


def _float64_distances(points: Tensor, queries: Tensor) -> Tensor:
    """Distances to the nearest points by brute force in float64, of a sample of the queries (every n-th row)."""
    some = queries[:: max(1, len(queries) // 512)].double()
    every = (some[:, None] - points.double()[None]).square().sum(dim=-1).sqrt()
    return every.topk(min(K, len(points)), dim=1, largest=False).values


def _error(distance: Tensor, truth: Tensor, max_radius: float | None) -> float:
    """Largest difference to float64, metres; what lies beyond the radius counts as the radius."""
    some = distance[:: max(1, len(distance) // 512)].double()
    if max_radius is not None:
        some, truth = some.clamp(max=max_radius), truth.clamp(max=max_radius)
    return float((some - truth).abs().max())


def _cores() -> int:
    return min(2, os.cpu_count() or 1)


def draw(result: Result, path: Path) -> None:
    """Draw all searches."""
    plots.bars(result.rows, "Nearest neighbours", path)
