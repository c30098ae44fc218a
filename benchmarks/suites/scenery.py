"""Pictures with scenery (every pixel that stands still is a point) and without: frames, updates, growth with points.

What is drawn is made up: a floor with boxes that stands still, and a block that moves above it. Without scenery both
are 1,280 particles, as the released models had them; with it the block is as before and the rest is scenery. Of four
lights one shines, as in a trained model.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch

from benchmarks import plots, stages
from benchmarks.measuring import Options, Result, Row, device_peak, interleaved, row
from benchmarks.memory_probe import peak_of
from benchmarks.worlds import block_above, floor_as_seen, picture_rays, surface_particles
from vpd_lightning.renderer.splat import SplatRenderer
from vpd_lightning.types import Particles, Rays

MOVING, STATIC = 512, 768
VIEWS = 4  # cameras whose pixels are the points
STEPS, CLIPS, RAYS = 4, 4, 256  # of an update
SWITCHES = {"color_features": True, "facing_softness": 0.1, "num_scenery_candidates": 12}


def run(options: Options) -> Result:
    """Measure frames, the renderer's part of an update, then growth; exponents are fitted in logarithms."""
    rows = []
    for size in options.pick((64, 128), (64,), (8,)):
        rows += _frames(size, options)
    rows += _updates(options)
    sizes = [2**power for power in options.pick(range(10, 18), range(10, 15), range(6, 9))]
    rows += _growth(sizes, replace(options, repeats=min(options.repeats, 3)))
    facts = {}
    for name in ("first frame", "next frame"):
        points = [(int(r.name.split("/")[1]), r.seconds or 0.0) for r in rows if r.name.startswith(f"{name}/")]
        facts[f"exponent of {name}"] = plots.fitted_exponent(*zip(*points, strict=True))[0]
    return Result(rows, facts)


def renderer(has_scenery: bool, num_lights: int) -> SplatRenderer:
    """Build the renderer of ``model=inertial``; the first light takes a fifth of the light, the others are out."""
    torch.manual_seed(0)
    model: SplatRenderer = stages.build(
        "renderer/splat", "demo", has_scenery=has_scenery, num_lights=num_lights, **SWITCHES
    )
    if model.shadows is not None:
        with torch.no_grad():
            model.shadows.shares.fill_(-1.0)
            model.shadows.shares[0] = 0.2
    return model


def scene(points: int | None, batch: int = 1) -> Particles:
    """Return a block above a floor of so many points of scenery; None: of particles alone."""
    block = block_above(MOVING)
    if points is None:
        floor = surface_particles(STATIC)
        particles = Particles(
            torch.cat([block.positions, floor.positions], dim=1), torch.cat([block.features, floor.features], dim=1)
        )
    else:
        particles = replace(block, scenery=floor_as_seen(points, block.positions))
    return particles.mapped(lambda values: values.expand(batch, *values.shape[1:]).contiguous())


def frame(points: int | None, size: int, num_lights: int, is_first: bool, device: str = "cpu") -> Callable[[], None]:
    """Return one picture; a later one of a clip, by a camera that stands still, knows the scenery already."""
    where = torch.device(device)
    model = renderer(points is not None, num_lights if points is not None else 0).to(where).eval()
    particles, rays = scene(points).to(where), picture_rays(size).to(where)

    def call() -> None:
        # Other rays, although equal ones: for the renderer a camera that it has not seen yet.
        seen_from = Rays(rays.origins.clone(), rays.directions.clone()) if is_first else rays
        with torch.no_grad():
            model(particles, seen_from, None)

    return call


def update(points: int | None, num_lights: int, device: torch.device, is_tiny: bool) -> Callable[[], None]:
    """Return the renderer's part of an update, forward and backward, of all steps of all clips."""
    clips, count = (1, 16) if is_tiny else (CLIPS, RAYS)
    model = renderer(points is not None, num_lights if points is not None else 0).to(device)
    particles = scene(points, clips * STEPS).to(device)
    if particles.scenery is not None:  # one of a clip for all of its steps
        scenery = particles.scenery
        members = {name: value.expand(clips, *value.shape[1:]) for name, value in vars(scenery).items()}
        particles = replace(particles, scenery=type(scenery)(**members))
    parts = [picture_rays(64, count, seed) for seed in range(clips * STEPS)]
    rays = Rays(torch.cat([p.origins for p in parts]), torch.cat([p.directions for p in parts])).to(device)
    particles = replace(particles, positions=particles.positions.requires_grad_())

    def call() -> None:
        model.zero_grad()
        particles.positions.grad = None
        model(particles, rays, None).rgbs.square().mean().backward()

    return call


def _frames(size: int, options: Options) -> list[Row]:
    points, where = VIEWS * size**2, str(options.device)
    functions = {
        "without": frame(None, size, 0, True, where),
        "first frame": frame(points, size, 4, True, where),
        "next frame": frame(points, size, 4, False, where),
        "next frame, no lights": frame(points, size, 0, False, where),
    }
    seconds = interleaved(functions, options.repeats, options.device)
    rows = [row(f"{size}x{size}/without scenery", seconds["without"], note=f"{MOVING + STATIC} particles")]
    note = f"{MOVING} particles that move, {points} points of scenery"
    for name in list(functions)[1:]:
        rows.append(row(f"{size}x{size}/{name}", seconds[name], "without scenery", seconds["without"], note=note))
    return rows


def _updates(options: Options) -> list[Row]:
    points, is_tiny = options.pick(VIEWS * 64**2, VIEWS * 64**2, 64), options.size == "tiny"
    functions = {
        "without scenery": update(None, 0, options.device, is_tiny),
        "with scenery": update(points, 4, options.device, is_tiny),
        "with scenery, no lights": update(points, 0, options.device, is_tiny),
    }
    seconds = interleaved(functions, options.repeats, options.device)
    note = f"the renderer alone, forward and backward: {CLIPS} clips of {STEPS} steps of {RAYS} rays"
    there = seconds["without scenery"]
    rows = [row("update/without scenery", there, note=note)]
    for name in list(functions)[1:]:
        rows.append(row(f"update/{name}", seconds[name], "without scenery", there, note=note))
    return rows


def _growth(sizes: list[int], options: Options) -> list[Row]:
    size, where = options.pick(128, 64, 8), str(options.device)
    rows = []
    for name, is_first in (("first frame", True), ("next frame", False)):
        functions = {str(count): frame(count, size, 4, is_first, where) for count in sizes}
        seconds = interleaved(functions, options.repeats, options.device)
        rows += [row(f"{name}/{count}", seconds[str(count)], note=f"{size}x{size} pixels") for count in sizes]
    for count in sizes[:: len(sizes) - 1]:  # each takes a process of its own
        arguments = {"points": count, "size": size, "num_lights": 4, "is_first": True, "device": where}
        if options.device.type == "cuda":
            peak = device_peak(frame(**arguments), options.device)
        else:
            peak = max(1, peak_of("suites.scenery:frame", **arguments)["peak_bytes"])
        rows.append(row(f"memory/{count}", peak_bytes=peak, note="first frame, beyond weights and input"))
    return rows


def draw(result: Result, path: Path) -> None:
    """Draw the time of frames over points of scenery; what memory is needed beside the points hardly changes."""
    curves: dict[str, tuple[list[float], list[float]]] = {}
    for item in result.rows:
        name, _, count = item.name.rpartition("/")
        if name in ("first frame", "next frame"):
            sizes, values = curves.setdefault(name, ([], []))
            sizes.append(float(count))
            values.append(1000 * (item.seconds or 0.0))
    plots.scaling({"Frame, milliseconds": curves}, path)
