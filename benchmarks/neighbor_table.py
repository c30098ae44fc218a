"""Measure every installed CPU backend of the neighbour search and write the table that ``auto`` is checked against.

    python -m benchmarks.neighbor_table [--threads 1] [--repeats 3] [--rays 1536] [--json PATH]

Points lie on surfaces (a floor, spheres, a cube), queries are samples along rays or such points. Repeats are
interleaved, so that a busy machine disturbs all backends alike, and the fastest repeat counts. Seconds are processor
seconds of all threads, so that what else runs on the machine is left out.

Also measured: the search that the paper's renderer asks for, 16,384 points, 1,536 rays of 384 samples, k = 16, with and
without a bound. The bound 2.06 m is where 16 of the paper's widest kernel (radius 0.5 m, bandwidth 0.5 m) sum to less
than 1e-3.
"""

import argparse
import importlib.util
import json
import math
import platform
import time
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from vpd_lightning.graph import neighbors
from vpd_lightning.graph.neighbors import PointIndex

PACKAGES = {"torch": "torch", "scipy": "scipy", "torch_cluster": "torch_cluster", "numba": "numba"}
"""CPU backend -> the package that it needs."""

_MOST_PAIRS = 1 << 28
"""Brute force above this many pairs is left out: its time is proportional, and nobody wants to wait."""

KNN_SIZES = [
    (points, queries, k) for points in (16, 64, 256, 1024, 16384, 131072) for queries in (256, 4096) for k in (2, 16)
]
"""Points, queries, k. Samples along rays; up to 1,024 points the queries are as incoherent as particles may be."""

RADIUS_SIZES = [(64, 0.6), (256, 0.3), (1024, 0.15), (16384, 0.03)]
"""Points, which are also the queries, and the radius in metres: about a dozen neighbours."""


def surface_points(count: int, seed: int = 0) -> Tensor:
    """Return points [point, 3] in metres on a floor of 2 m, two spheres and a cube, in random order."""
    generator = torch.Generator().manual_seed(seed)
    floor = torch.rand(count, 3, generator=generator) * 2 - 1
    floor[:, 2] = 0
    sphere = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1) * 0.2
    sphere += torch.tensor([[-0.4, 0.3, 0.2], [0.5, -0.2, 0.25]])[torch.randint(0, 2, (count,), generator=generator)]
    cube = torch.rand(count, 3, generator=generator) * 2 - 1
    axis = torch.randint(0, 3, (count,), generator=generator)
    cube[torch.arange(count), axis] = torch.randint(0, 2, (count,), generator=generator) * 2.0 - 1
    cube = cube * 0.15 + torch.tensor([0.3, 0.5, 0.15])
    kind = torch.rand(count, 1, generator=generator)
    return torch.where(kind < 0.5, floor, torch.where(kind < 0.75, sphere, cube)).contiguous()


def ray_samples(rays: int, samples: int, seed: int = 0) -> Tensor:
    """Return stratified samples [ray * sample, 3] from 0.3 to 5 m along rays of six cameras 2.5 m from the middle."""
    generator = torch.Generator().manual_seed(seed)
    angle = torch.arange(rays).mul(6).div(rays, rounding_mode="floor") * 1.1
    eyes = torch.stack([2 * angle.cos(), 2 * angle.sin(), torch.full_like(angle, 1.5)], dim=1)
    forward = torch.nn.functional.normalize(-eyes, dim=1)
    right = torch.nn.functional.normalize(
        torch.linalg.cross(forward, torch.tensor([[0.0, 0, 1]]).expand_as(forward)), dim=1
    )
    up = torch.linalg.cross(right, forward)
    pixel = (torch.rand(rays, 2, generator=generator) * 2 - 1) * 0.45
    directions = torch.nn.functional.normalize(forward + pixel[:, :1] * right + pixel[:, 1:] * up, dim=1)
    edges = torch.linspace(0.3, 5, samples + 1)
    depth = edges[:-1] + torch.rand(rays, samples, generator=generator) * (edges[1] - edges[0])
    return (eyes[:, None] + directions[:, None] * depth[..., None]).reshape(-1, 3)


def fastest(work: dict[str, Any], repeats: int) -> dict[str, float]:
    """Return seconds of the fastest of ``repeats`` interleaved calls; a first round warms up and compiles."""
    seconds = dict.fromkeys(work, math.inf)
    for repeat in range(repeats + 1):
        for name, call in work.items():
            start = time.process_time()
            call()
            if repeat:
                seconds[name] = min(seconds[name], time.process_time() - start)
    return {name: float(f"{value:.3g}") for name, value in seconds.items()}


def table(backends: list[str], repeats: int) -> list[dict[str, Any]]:
    """Measure building the index and searching once, as ``auto`` has to weigh both."""
    rows = []
    for num_points, num_queries, k in KNN_SIZES:
        points = surface_points(num_points)
        queries = surface_points(num_queries, 1) if num_points <= 1024 else ray_samples(num_queries // 64, 64)
        able = [name for name in backends if name != "torch" or num_points * num_queries <= _MOST_PAIRS]
        work = {name: lambda name=name: PointIndex(points, name).knn(queries, k) for name in able}  # noqa: B023
        row = {"device": "cpu", "search": "knn", "points": num_points, "queries": num_queries, "k": k}
        rows.append(row | {"seconds": fastest(work, repeats)})
    for num_points, reach in RADIUS_SIZES:
        points = surface_points(num_points)
        able = [name for name in backends if name != "torch" or num_points**2 <= _MOST_PAIRS]
        work = {name: lambda name=name: PointIndex(points, name).radius(points, reach) for name in able}  # noqa: B023
        row = {"device": "cpu", "search": "radius", "points": num_points, "queries": num_points, "k": None}
        rows.append(row | {"seconds": fastest(work, repeats)})
    return rows


def renderer_search(backends: list[str], repeats: int, rays: int = 1536) -> list[dict[str, Any]]:
    """Measure the search of the paper's training step, through our contract and as the libraries are called plainly."""
    points, queries = surface_points(16384), ray_samples(rays, 384)
    rows = []
    for max_radius in (None, 2.06, 0.3, 0.15):
        indices = {name: PointIndex(points, name) for name in backends if name != "torch"}
        work = {name: lambda one=one: one.knn(queries, 16, max_radius) for name, one in indices.items()}  # noqa: B023
        work |= _plain_libraries(points, queries, max_radius, backends)
        found = {name: one.knn(queries[:20000], 16, max_radius) for name, one in indices.items()}
        same = all(torch.equal(one.distance, found["numba"].distance) for one in found.values())
        row = {"points": len(points), "queries": len(queries), "k": 16, "max_radius": max_radius}
        rows.append(row | {"seconds": fastest(work, repeats), "same_distances": same})
    return rows


def _plain_libraries(points: Tensor, queries: Tensor, max_radius: float | None, backends: list[str]) -> dict[str, Any]:
    from scipy.spatial import cKDTree

    tree, double = cKDTree(points.double().numpy()), queries.double().numpy()
    bound = math.inf if max_radius is None else max_radius
    work = {"scipy alone, workers=-1": lambda: tree.query(double, 16, distance_upper_bound=bound, workers=-1)}
    if "torch_cluster" in backends:
        import torch_cluster

        work["torch_cluster.knn alone, unbounded"] = lambda: torch_cluster.knn(points, queries, 16)
    return work


def main() -> None:
    """Measure, write, and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--rays", type=int, default=1536, help="rays of the renderer's search; 0 leaves it out")
    parser.add_argument("--json", type=Path, default=Path(neighbors.__file__).with_name("automatic.json"))
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    backends = [name for name, package in PACKAGES.items() if importlib.util.find_spec(package)]
    result = {
        "machine": {
            "cpu": platform.processor() or platform.machine(),
            "threads": options.threads,
            "torch": torch.__version__,
            "statistic": f"processor seconds, fastest of {options.repeats} interleaved repeats",
            "rows": "time to build the index and search once; renderer_search: to search",
        },
        "renderer_search": renderer_search(backends, options.repeats, options.rays) if options.rays else [],
        "rows": table(backends, options.repeats),
    }
    lines = [f'  "machine": {json.dumps(result["machine"])}']
    for name in ("renderer_search", "rows"):
        rows = ",\n".join("    " + json.dumps(row) for row in result[name])
        lines.append(f'  "{name}": [\n{rows}\n  ]')
    options.json.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
    print(options.json.read_text(encoding="utf-8"))


if __name__ == "__main__":
    main()
