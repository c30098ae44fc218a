"""Run time against error of every knob that needs no new training, on trained checkpoints; see ``knobs``."""

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks import plots
from benchmarks.knobs import DYNAMICS_KNOBS, RENDERER_KNOBS, Knob, reference_changes
from benchmarks.measuring import Options, Result, Row, interleaved, row
from benchmarks.models import Model, load_models
from benchmarks.plots import Point
from vpd_lightning.geometry.cameras import pixel_rays
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.simulator import Simulator
from vpd_lightning.types import Particles, Rays

HORIZONS = (1, 4, 8)  # predicted steps whose pictures are compared
DEFAULT = "default"
_KEYS = RandomKeys.fixed(1)


@dataclass(frozen=True)
class View:
    """Particles of several predicted steps as a batch, random pixels of all cameras, and their true colours."""

    particles: Particles
    rays: Rays
    truth: Tensor


def run(options: Options) -> Result:
    """Measure all knobs of all checkpoints; without checkpoints there is nothing to be accurate about."""
    rows: list[Row] = []
    facts: dict[str, Any] = {}
    for name, model in load_models(options).items():
        found = _renderer_knobs(name, model, options) + _dynamics_knobs(name, model, options)
        rows += found
        facts |= {f"{name}: {key}": value for key, value in _front_facts(found).items()}
    if not rows:
        facts["note"] = "no checkpoint was given (ckpt=[...]), so nothing was measured"
    return Result(rows, facts)


def view_of(
    model: Model,
    num_rays: int,
    device: torch.device,
    horizons: Sequence[int] = HORIZONS,
    trajectory: int = 0,
    cameras: Sequence[int] | None = None,
) -> View:
    """Predict one test clip and choose pixels of ``cameras``, or of all."""
    clip = model.clip(max(horizons), trajectory)
    views = model.input_views
    inputs = clip.cameras[:, views].to(device)
    scene = model.simulator.encode(clip.rgb[:, views].to(device), clip.depth[:, views].to(device), inputs)
    states = model.simulator.rollout(scene, max(horizons))
    shown = list(range(clip.target_rgb.shape[1])) if cameras is None else list(cameras)
    generator = torch.Generator().manual_seed(0)
    origins, directions, colors = [], [], []
    for horizon in horizons:
        rays = pixel_rays(clip.target_cameras[horizon - 1][shown])
        chosen = torch.randint(0, rays.origins[..., 0].numel(), (num_rays,), generator=generator)
        origins.append(rays.origins.reshape(-1, 3)[chosen])
        directions.append(rays.directions.reshape(-1, 3)[chosen])
        colors.append(clip.target_rgb[horizon - 1][shown].reshape(-1, 3)[chosen].float() / 255)
    kept = [states[horizon - 1] for horizon in horizons]
    particles = Particles(
        *(torch.cat([getattr(state, key) for state in kept]) for key in ("positions", "features", "mask"))
    )
    rays = Rays(torch.stack(origins).float().to(device), torch.stack(directions).float().to(device))
    return View(particles, rays, torch.stack(colors).to(device))


def _colors(simulator: Simulator, view: View, particles: Particles, is_bf16: bool) -> Tensor:
    device = view.rays.origins.device.type
    with torch.no_grad(), torch.autocast(device, torch.bfloat16) if is_bf16 else nullcontext():
        return simulator.renderer(particles, view.rays, None).rgbs


def _fewer(particles: Particles, share: float) -> Particles:
    """Keep a random share of the particles."""
    count = particles.num_particles
    kept = torch.randperm(count, generator=torch.Generator().manual_seed(0))[: max(1, round(share * count))]
    kept = kept.sort().values.to(particles.mask.device)
    return Particles(particles.positions[:, kept], particles.features[:, kept], particles.mask[:, kept])


def _renderer_knobs(name: str, model: Model, options: Options) -> list[Row]:
    view = view_of(model, options.pick(512, 128, 16), options.device, options.pick(HORIZONS, HORIZONS, (1,)))
    kind = model.kind("renderer")
    reference = model.variant("renderer", **reference_changes(kind, model.config["renderer"])).double()
    exact = _colors(
        reference,
        View(view.particles, view.rays.to(torch.float64), view.truth),
        view.particles.to(torch.float64),
        False,
    )
    functions, labels = {}, {}
    colors = {}
    for knob, label, changes in _settings(RENDERER_KNOBS.get(kind, ()), model, "renderer", options):
        simulator = model.variant("renderer", **changes) if changes else model.simulator
        particles = _fewer(view.particles, float(label)) if knob == "particles kept" else view.particles
        is_bf16 = label == "bf16"
        key = f"{name}/{knob}/{label}"

        def call(simulator=simulator, particles=particles, is_bf16=is_bf16) -> Tensor:
            return _colors(simulator, view, particles, is_bf16)

        functions[key], labels[key] = call, label
        colors[key] = call()
    seconds = interleaved(functions, options.repeats, options.device, warm_up=False)
    default = f"{name}/{DEFAULT}/{DEFAULT}"
    rows = []
    for key in functions:
        error = float((colors[key].double() - exact).square().mean().sqrt())
        psnr = -10 * float((colors[key].clamp(0, 1) - view.truth).square().mean().clamp(min=1e-10).log10())
        note = f"{view.truth.shape[0]} states, {view.truth.shape[1]} pixels each; RMS error of colour to float64"
        rows.append(row(key, seconds[key], DEFAULT, seconds[default], error, psnr, note=note))
    return rows


def _dynamics_knobs(name: str, model: Model, options: Options) -> list[Row]:
    """Positions after a few steps against those of the finest setting in float64, and the pictures of them."""
    knobs = DYNAMICS_KNOBS.get(model.kind("dynamics"), ())
    settings = list(_settings(knobs, model, "dynamics", options))
    if len(settings) < 2:
        return []
    steps = options.pick(8, 4, 1)
    clip = model.clip(steps)
    views = model.input_views
    rgb, depth = clip.rgb[:, views].to(options.device), clip.depth[:, views].to(options.device)
    cameras = clip.cameras[:, views].to(options.device)
    scene = model.simulator.encode(rgb, depth, cameras)
    rays = pixel_rays(clip.target_cameras[steps - 1].to(options.device))
    flat = Rays(*(t.reshape(-1, 3)[:: options.pick(8, 16, 64)][None].float() for t in (rays.origins, rays.directions)))
    truth = clip.target_rgb[steps - 1].reshape(-1, 3)[:: options.pick(8, 16, 64)].float().to(options.device) / 255
    double = model.variant("dynamics").double()
    with torch.no_grad():
        exact = double.unroll(scene.previous.to(torch.float64), scene.current.to(torch.float64), steps, _KEYS)
    functions, ends = {}, {}
    for knob, label, changes in settings:
        simulator = model.variant("dynamics", **changes) if changes else model.simulator

        def call(simulator=simulator) -> Particles:
            return simulator.rollout(scene, steps)[-1]

        key = f"{name}, dynamics/{knob}/{label}"
        functions[key], ends[key] = call, call()
    seconds = interleaved(functions, options.repeats, options.device, warm_up=False)
    default = f"{name}, dynamics/{DEFAULT}/{DEFAULT}"
    rows = []
    valid = scene.current.mask
    for key, end in ends.items():
        offset = (end.positions.double() - exact[-1].positions)[valid]
        error = float(offset.square().sum(dim=-1).mean().sqrt())
        with torch.no_grad():
            picture = model.simulator.renderer(end, flat, None).rgbs[0].clamp(0, 1)
        psnr = -10 * float((picture - truth).square().mean().clamp(min=1e-10).log10())
        note = f"{steps} steps; RMS difference of positions (metres) to the trained setting in float64"
        rows.append(row(key, seconds[key], DEFAULT, seconds[default], error, psnr, note=note))
    return rows


def _settings(knobs: Sequence[Knob], model: Model, stage: str, options: Options):
    """Yield (knob, value's name, changes): first the default, then the values of all knobs that the stage has."""
    yield DEFAULT, DEFAULT, {}
    for knob in knobs:
        if knob.keys and not all(model.knows(stage, key) for key in knob.keys):
            continue
        values = [
            value for value in knob.values_for(model.config[stage]) if knob.is_allowed(model.config[stage], value)
        ]
        for value in options.pick(values, values[::2], values[:1]):
            yield knob.name, knob.label(value), knob.changes(value)


def points(rows: Sequence[Row]) -> dict[str, dict[str, list[Point]]]:
    """Sort rows into model -> knob -> points; every curve goes through the default, from fast to slow."""
    panels: dict[str, dict[str, list[Point]]] = {}
    defaults: dict[str, Point] = {}
    for item in rows:
        name, knob, label = item.name.rsplit("/", 2)
        point = Point(label, item.seconds or 0.0, item.error or 0.0, item.psnr, knob == DEFAULT)
        if point.is_default:
            defaults[name] = point
            panels[name] = {}
        else:
            panels[name].setdefault(knob, [defaults[name]]).append(point)
    for knobs in panels.values():
        for curve in knobs.values():
            curve.sort(key=lambda p: p.seconds)
    return panels


def _front_facts(rows: Sequence[Row]) -> dict[str, Any]:
    """Say whether the default lies on the front, and by how much a better setting beats it in time."""
    facts: dict[str, Any] = {}
    for name, knobs in points(rows).items():
        every = list({id(p): p for curve in knobs.values() for p in curve}.values())
        default = next((p for p in every if p.is_default), None)
        if default is None:
            continue
        # What is faster by less than the noise of such a measurement does not count.
        better = [p for p in every if p.error <= default.error and p.seconds < 0.95 * default.seconds]
        facts[f"default on the front ({name.rsplit(', ', 1)[-1]})"] = not better
        if better:
            facts[f"beaten by ({name.rsplit(', ', 1)[-1]})"] = ", ".join(
                f"{knob} {p.label}" for knob, curve in knobs.items() for p in curve if p in better
            )
    return facts


def draw(result: Result, path: Path) -> None:
    """Draw one row of panels per model."""
    panels = {name: knobs for name, knobs in points(result.rows).items() if knobs}
    if panels:
        plots.time_error(panels, path)
