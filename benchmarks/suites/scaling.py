"""Time and memory over the number of particles: dynamics, one frame, and a rollout of 2^17 particles."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from benchmarks import plots, stages
from benchmarks.measuring import Options, Result, Row, device_peak, interleaved, row
from benchmarks.memory_probe import peak_of
from benchmarks.worlds import picture_rays, two_frames
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.types import Particles

KEYS = RandomKeys.fixed(1)
LIMIT_BYTES = 16 * 2**30
TINY = {"hidden_dim": 16, "message_passing_steps": 2}


def run(options: Options) -> Result:
    """Measure over particle counts; exponents are fitted in logarithms."""
    sizes = [2**power for power in options.pick(range(12, 18), range(12, 15), range(6, 9))]
    options = replace(options, repeats=min(options.repeats, options.pick(2, 2, 1)))  # there are many sizes
    rows, facts = _dynamics(sizes, options)
    more, exponents = _frames(sizes, options)
    rows += more
    facts |= exponents
    more, exponents = _memory(sizes, options)
    rows += more
    facts |= exponents
    rows += _growing(sizes, options)
    if options.size == "full":
        rows.append(_long(sizes[-1], options))
    for name in ("dynamics, particles' part", "frame", "memory"):
        points = [(int(r.name.split("/")[1]), r.seconds or r.peak_bytes) for r in rows if r.name.startswith(f"{name}/")]
        facts[f"exponent of {name}"] = plots.fitted_exponent(*zip(*points, strict=True))[0]
    return Result(rows, facts)


def step(count: int, device: torch.device, is_tiny: bool, **changes: Any) -> Callable[[], None]:
    """Return one dynamics step of the paper's network at inference."""
    torch.manual_seed(0)
    model = stages.build("dynamics/hierarchical_gnn", "mujoco", **{**(TINY if is_tiny else {}), **changes})
    model = model.to(device).eval()
    previous, current = (p.to(device) for p in two_frames(count))

    def call() -> None:
        with torch.no_grad():
            model(previous, current, None, KEYS, 0)

    return call


def frame(count: int, device: torch.device, size: int) -> Callable[[], None]:
    """Return one frame of the surface renderer."""
    torch.manual_seed(0)
    model = stages.build("renderer/surface", "mujoco").to(device).eval()
    particles, rays = two_frames(count)[1].to(device), picture_rays(size).to(device)

    def call() -> None:
        with torch.no_grad():
            model(particles, rays, None)

    return call


def _dynamics(sizes: list[int], options: Options) -> tuple[list[Row], dict[str, Any]]:
    """Whole steps, and steps whose abstract nodes have no edges among them: what is left grows with the particles."""
    rows, whole_seconds, rest_seconds = [], [], []
    is_tiny = options.size == "tiny"
    nodes = options.pick(1024, 1024, 16)
    for count in sizes:
        functions = {
            "whole": step(count, options.device, is_tiny, num_abstract_nodes=nodes),
            "rest": step(count, options.device, is_tiny, num_abstract_nodes=nodes, r_a_s=1e-6),
        }
        seconds = interleaved(functions, options.repeats, options.device)
        peak = device_peak(functions["whole"], options.device)
        whole = row(f"dynamics/{count}", seconds["whole"], peak_bytes=peak, note=f"{nodes} abstract nodes")
        note = "the same step without edges among abstract nodes"
        rest = row(f"dynamics, particles' part/{count}", seconds["rest"], "whole step", seconds["whole"], note=note)
        rows += [whole, rest]
        whole_seconds.append(whole.seconds or 0.0)
        rest_seconds.append(rest.seconds or 0.0)
    constant = [a - b for a, b in zip(whole_seconds, rest_seconds, strict=True)]
    return rows, {"constant abstract part, seconds": sorted(constant)[len(constant) // 2]}


def _frames(sizes: list[int], options: Options) -> tuple[list[Row], dict[str, Any]]:
    size = options.pick(128, 64, 8)
    functions = {count: frame(count, options.device, size) for count in sizes}
    seconds = interleaved({str(c): f for c, f in functions.items()}, options.repeats, options.device)
    note = f"surface, {size}x{size} pixels"
    return [
        row(f"frame/{c}", seconds[str(c)], peak_bytes=device_peak(f, options.device), note=note)
        for c, f in functions.items()
    ], {}


def step_and_frame(count: int, nodes: int, size: int, is_tiny: bool, device: str = "cpu") -> Callable[[], None]:
    """Return one dynamics step and one frame, for their memory."""
    parts = (
        step(count, torch.device(device), is_tiny, num_abstract_nodes=nodes),
        frame(count, torch.device(device), size),
    )

    def call() -> None:
        for part in parts:
            part()

    return call


def _memory(sizes: list[int], options: Options) -> tuple[list[Row], dict[str, Any]]:
    is_tiny = options.size == "tiny"
    nodes, size = options.pick(1024, 1024, 16), options.pick(128, 64, 8)
    some = options.pick(sizes, sizes, sizes[:: len(sizes) - 1])  # each takes a process of its own
    rows = []
    for count in some:
        if options.device.type == "cuda":
            peak = device_peak(step_and_frame(count, nodes, size, is_tiny, "cuda"), options.device)
        else:
            arguments = {"count": count, "nodes": nodes, "size": size, "is_tiny": is_tiny}
            peak = max(1, peak_of("suites.scaling:step_and_frame", **arguments)["peak_bytes"])
        rows.append(row(f"memory/{count}", peak_bytes=peak, note="one step and one frame, beyond weights and input"))
    return rows, {}


def _growing(sizes: list[int], options: Options) -> list[Row]:
    """One abstract node per 16 particles; with fixed radii edges grow as the square of the nodes.

    On surfaces the distance between nodes goes with the inverse root of their number; radii that follow keep the number
    of edges per node, and with it the work per particle.
    """
    is_tiny = options.size == "tiny"
    rows = []
    for kind, last in (("fixed radius", options.pick(2**15, 2**14, 2**8)), ("shrinking radius", sizes[-1])):
        for count in [size for size in sizes if size <= last]:
            nodes = count // 16
            scale = 1.0 if kind == "fixed radius" else (1024 / nodes) ** 0.5
            changes = {"num_abstract_nodes": nodes, "r_s": 0.1 * scale, "r_a_s": 0.3 * scale}
            function = step(count, options.device, is_tiny, **changes)
            repeats = options.repeats if count <= 2**14 else 1
            seconds = interleaved({"step": function}, repeats, options.device, warm_up=count <= 2**14)["step"]
            note = f"{nodes} abstract nodes, r_a {0.3 * scale:.2f} m"
            rows.append(row(f"nodes grow, {kind}/{count}", seconds, note=note))
    return rows


def roll_out_and_render(count: int, steps: int, size: int, device: str = "cpu") -> Callable[[], Any]:
    """Return a rollout of several steps and the frame after it; the call says whether all numbers were finite."""
    torch.manual_seed(0)
    where = torch.device(device)
    model = stages.build("dynamics/hierarchical_gnn", "mujoco").to(where).eval()
    renderer = stages.build("renderer/surface", "mujoco").to(where).eval()
    states = two_frames(count)
    rays = picture_rays(size).to(where)

    def call() -> bool:
        previous, current = (p.to(where) for p in states)
        with torch.no_grad():
            for number in range(steps):
                following: Particles = model(previous, current, None, KEYS, number)[0]
                previous, current = current, following
            picture = renderer(current, rays, None).rgbs
        return bool(torch.isfinite(current.positions).all() and torch.isfinite(picture).all())

    return call


def _long(count: int, options: Options) -> Row:
    """The largest scene in a process of its own; the whole process must fit."""
    if options.device.type == "cuda":
        call = roll_out_and_render(count, 3, 128, "cuda")
        peak = device_peak(call, options.device) or 0
        answer = call()
    else:
        measured = peak_of("suites.scaling:roll_out_and_render", count=count, steps=3, size=128)
        peak, answer = measured["process_bytes"], measured["answer"]
    if not answer or peak > LIMIT_BYTES:
        raise AssertionError(f"{count} particles: finite {answer}, {peak / 2**30:.1f} GiB (limit 16)")
    return row(f"rollout and frame/{count}", peak_bytes=peak, note="3 steps, one 128x128 frame; the whole process")


def draw(result: Result, path: Path) -> None:
    """Draw time and memory over particles."""
    curves: dict[str, tuple[list[float], list[float]]] = {}
    memory: dict[str, tuple[list[float], list[float]]] = {}
    for item in result.rows:
        name, _, count = item.name.rpartition("/")
        if name.startswith("rollout"):
            continue
        if item.seconds is not None:
            x, y = curves.setdefault(name, ([], []))
            y.append(1000 * item.seconds)
        else:
            x, y = memory.setdefault("one step and one frame", ([], []))
            y.append((item.peak_bytes or 0) / 2**20)
        x.append(float(count))
    dynamics = {name: curve for name, curve in curves.items() if name != "frame"}
    panels = {
        "Dynamics step, milliseconds": dynamics,
        "Frame with surface, milliseconds": {"frame": curves["frame"]},
        "Memory, MiB": memory,
    }
    plots.scaling(panels, path)
