"""Renderers and their switches: time of rays without and with gradients, and the difference in colour."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from benchmarks import plots, stages
from benchmarks.arithmetic import renderer_layers, work
from benchmarks.measuring import Options, Result, Row, copy_rate, device_peak, gemm_rate, interleaved, num_threads, row
from benchmarks.plain import renderer as plain
from benchmarks.worlds import picture_rays, surface_particles
from vpd_lightning.types import Particles, Rays, RenderedRays

# Exact switches turned off, then the bounded one turned on; what a version does not have is left out.
SWITCHES: dict[str, Any] = {
    "reuse_coarse": False,
    "sort_particles": False,
    "features_backend": "torch",
    "checkpoint_chunks": False,
    "max_radius": 2.06,  # features off by at most 1e-3 of the largest: bounds.radius_for of the paper's MuJoCo kernels
}
OFF = ("reuse_coarse", "sort_particles", "features_backend", "checkpoint_chunks")


def run(options: Options) -> Result:
    """Measure frames, then the volume renderer's switches."""
    count = options.pick(16384, 4096, 128)
    particles = surface_particles(count).to(options.device)
    rows, facts = _frames(particles, options)
    return Result(rows + _switches(particles, options), facts)


def volume(options: Options, **changes: Any) -> nn.Module:
    """Build the paper's renderer (narrow networks in ``tiny``) with a field that stops light, as a trained one does."""
    small = {"num_coarse_samples": 8, "num_fine_samples": 8, "net_width": 16, "net_width_condition": 8}
    torch.manual_seed(0)
    model = stages.build("renderer/point_nerf", "mujoco", **options.pick({}, {}, small), **changes)
    for field in (model.coarse, model.fine):
        # Features are positive and small far from particles: this density is high near them and low elsewhere.
        nn.init.normal_(field.density.weight, std=0.5)
        nn.init.zeros_(field.density.bias)
    return model.to(options.device).eval()


def without_gradient(model: nn.Module, particles: Particles, rays: Rays) -> Callable[[], RenderedRays]:
    """Return the rendering of rays as at inference."""

    def call() -> RenderedRays:
        with torch.no_grad():
            return model(particles, rays, None)

    return call


def with_gradient(model: nn.Module, particles: Particles, rays: Rays) -> Callable[[], None]:
    """Return forward and backward pass to weights, positions and features."""

    def call() -> None:
        positions, features = (t.detach().requires_grad_() for t in (particles.positions, particles.features))
        model.zero_grad(set_to_none=True)
        model(Particles(positions, features), rays, None).rgbs.square().mean().backward()

    return call


def _frames(particles: Particles, options: Options) -> tuple[list[Row], dict[str, Any]]:
    device = options.device
    size = options.pick(128, 64, 8)
    rays, some = picture_rays(size).to(device), picture_rays(size, options.pick(64, 32, 8)).to(device)
    models = {"point_nerf": volume(options)}
    torch.manual_seed(0)
    for name in ("surface", "splat"):
        models[name] = stages.build(f"renderer/{name}", "mujoco").to(device).eval()
    model = models["point_nerf"]

    def plain_rays() -> RenderedRays:
        with torch.no_grad():
            return plain.render(model, particles, some, None, ray_chunk_size=64)

    volume_rays = without_gradient(model, particles, some)
    error = _difference(volume_rays(), plain_rays())
    truth = _float64(model, particles, some)
    seconds = interleaved(
        {
            "volume": volume_rays,
            "plain": plain_rays,
            **{n: without_gradient(m, particles, rays) for n, m in models.items() if n != "point_nerf"},
        },
        options.repeats,
        device,
    )
    counted = f"{some.origins.shape[1]} rays, {particles.num_particles} particles"
    rows = [
        row(
            "rays/point_nerf", seconds["volume"], "plain", seconds["plain"], error,
            note=f"{counted}; largest difference in colour to plain",
        ),
        row("rays/plain", seconds["plain"], note=counted),
    ]  # fmt: skip
    share = rays.origins.shape[1] / some.origins.shape[1]
    for name in ("surface", "splat"):
        whole = [share * value for value in seconds["volume"]]
        note = (
            f"{size}x{size} frame; untrained, other networks than point_nerf, whose time is scaled from the rays above"
        )
        render = without_gradient(models[name], particles, rays)
        peak = device_peak(render, device)
        rows.append(row(f"frame/{name}", seconds[name], "point_nerf", whole, peak_bytes=peak, note=note))
    with num_threads(options.pick(2, 2, 1)):
        two = interleaved({"frame": without_gradient(models["surface"], particles, rays)}, options.repeats, device)
    rows.append(row("frame/surface, two threads", two["frame"], note=f"{size}x{size}, wall time"))
    amount = work(renderer_layers(model, some.origins.shape[1], has_coarse_color=False))
    operations, moved = gemm_rate(device), copy_rate(device)
    floor = amount.seconds(operations, moved)
    facts = {
        "gemm_operations_per_second": operations,
        "copied_bytes_per_second": moved,
        "point_nerf_operations_per_ray": amount.operations / some.origins.shape[1],
        "point_nerf_bytes_per_ray": amount.bytes / some.origins.shape[1],
        "point_nerf_floor_share": floor / (rows[0].seconds or 1.0),
        "error_to_float64": float((volume_rays().rgbs.double() - truth).abs().max()),
    }
    return rows, facts


def _switches(particles: Particles, options: Options) -> list[Row]:
    """Turn one switch at a time, without and with gradients."""
    rays = picture_rays(128, options.pick(64, 32, 6)).to(options.device)
    known = stages.section("renderer/point_nerf")
    settings: dict[str, Mapping[str, Any]] = {"default": {}}
    settings |= {f"{key}={value}": {key: value} for key, value in SWITCHES.items() if key in known}
    models = {name: volume(options, **changes) for name, changes in settings.items()}
    rows = []
    for kind, make in (("rays", without_gradient), ("step", with_gradient)):
        seconds = interleaved(
            {name: make(model, particles, rays) for name, model in models.items()}, options.repeats, options.device
        )
        default = without_gradient(models["default"], particles, rays)()
        for name, model in models.items():
            if name == "default":
                continue
            is_off = name.partition("=")[0] in OFF
            note = "an exact switch turned off" if is_off else "a bounded omission turned on; difference in colour"
            error = _difference(without_gradient(model, particles, rays)(), default)
            peak = device_peak(make(model, particles, rays), options.device)
            here = seconds[name]
            rows.append(row(f"{kind}/{name}", here, "default", seconds["default"], error, peak_bytes=peak, note=note))
    return rows


def _difference(one: RenderedRays, other: RenderedRays) -> float:
    return float((one.rgbs - other.rgbs).abs().max())


def _float64(model: nn.Module, particles: Particles, rays: Rays) -> Tensor:
    """Colours of the plain path in float64 with the same weights."""
    from copy import deepcopy

    with torch.no_grad():
        double = deepcopy(model).double()
        return plain.render(double, particles.to(torch.float64), rays.to(torch.float64), None, ray_chunk_size=64).rgbs


def draw(result: Result, path: Path) -> None:
    """Draw all rows."""
    plots.bars(result.rows, "Renderers and the volume renderer's switches", path)
