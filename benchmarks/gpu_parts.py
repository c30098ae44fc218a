"""The parts of ``benchmarks.gpu``: each measures on one device and yields what it has after every row.

So a part whose time is up leaves the rows that it got to.
"""

import traceback
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from benchmarks import stages
from benchmarks.arithmetic import TRAINING, dynamics_layers, edge_counts, encoder_layers, renderer_layers, work
from benchmarks.measuring import Options, Result, Row, copy_rate, device_peak, gemm_rate, interleaved, row
from benchmarks.suites import neighbors as neighbors_suite
from benchmarks.suites import scaling as scaling_suite
from benchmarks.training_step import EDGES_PER_NODE, OTHER_RENDERERS, PAPER, TINY, Scale, Step
from benchmarks.worlds import picture_rays, surface_particles, two_frames
from vpd_lightning.graph.neighbors import PointIndex
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.renderer.kernels.fused_features import fused_annular_features
from vpd_lightning.types import Particles

KEYS = RandomKeys.fixed(1)
RADII, BANDWIDTHS = (0.0, 0.05, 0.1, 0.5), (0.05, 0.05, 0.05, 0.5)


def knn(options: Options) -> Iterator[Result]:
    """Search of the renderer's neighbours by the Triton kernel, its twin and what else is there, against float64."""
    yield neighbors_suite.run(options)


def features(options: Options) -> Iterator[Result]:
    """Sums under annular kernels, forward and backward, by the Triton kernel and by its twin, against float64."""
    device = options.device
    count, rays, samples = options.pick((16384, 512, 384), (4096, 128, 192), (33, 3, 7))
    particles = surface_particles(count).to(device)
    queries = neighbors_suite.ray_samples(rays, samples).to(device)
    found = PointIndex(particles.positions[0], "torch" if device.type == "cpu" else "auto").knn(queries, 16)
    found = type(found)(found.index[None], found.distance[None], found.mask[None])

    def sums(backend: str, dtype: torch.dtype, needs_gradient: bool) -> list[Tensor]:
        inputs = [t.detach().to(dtype) for t in (queries[None], particles.positions, particles.features)]
        inputs = [t.requires_grad_(needs_gradient) for t in inputs]
        near = type(found)(found.index, found.distance.to(dtype), found.mask)
        where = Particles(inputs[1], inputs[2], particles.mask)
        out = fused_annular_features(inputs[0], where, near, RADII, BANDWIDTHS, backend)
        if needs_gradient:
            weight = torch.linspace(-1, 1, out.numel(), device=device, dtype=dtype).view_as(out)
            (out * weight).sum().backward()
            return [out.detach(), *(t.grad for t in inputs)]
        return [out]

    truth = sums("torch", torch.float64, True)
    rows = []
    for needs_gradient, kind in ((False, "forward"), (True, "forward and backward")):
        functions = {
            name: (lambda name=name, gradient=needs_gradient: sums(name, torch.float32, gradient))
            for name in ("torch", "triton")
        }
        seconds = interleaved(functions, options.repeats, device)
        for name, function in functions.items():
            error = max(
                float((here.double() - there).norm() / there.norm().clamp(min=1e-30))
                for here, there in zip(function(), truth, strict=False)
            )
            note = f"{len(queries)} samples, 16 of {count}; largest relative error of values and gradients to float64"
            peak = device_peak(function, device)
            baseline = "" if name == "torch" else "torch"
            there = () if name == "torch" else seconds["torch"]
            rows.append(row(f"{kind}/{name}", seconds[name], baseline, there, error, None, peak, note))
            yield Result(rows)


def train_step(options: Options) -> Iterator[Result]:
    """One step at the paper's scale: the plain path in float32, ours in float32, bf16, compiled, with surface."""
    scale = options.pick(PAPER, PAPER, TINY)
    # The last one may take all the time that is left, to compile.
    variants = ("plain", "fast", "saving", "bf16", "surface", "surface_bf16", "compiled")
    rows: list[Row] = []
    facts: dict[str, Any] = {}
    plain_seconds: list[float] = []
    reference = None
    for variant in variants:  # one after the other: two of them need not fit beside each other
        print(f"train_step/{variant} begins", flush=True)
        try:
            step = Step(variant, scale, options.device)
            step()
            gradients = step.gradients()
            seconds = interleaved({"step": step}, options.repeats, options.device)["step"]
            peak = device_peak(step, options.device)
        except Exception as error:
            if variant in ("plain", "fast"):
                raise
            rows.append(row(f"train_step/{variant}", note=f"failed: {type(error).__name__}: {str(error)[:200]}"))
            facts[f"{variant} failed"] = traceback.format_exc()
            yield Result(rows, facts)
            continue
        if variant == "plain":
            reference, plain_seconds = gradients, seconds
        error = None
        if not variant.startswith(OTHER_RENDERERS) and reference is not None:
            error = float((gradients - reference).norm() / reference.norm())
        note = "gradients relative to plain" if error is not None else "another renderer"
        baseline = "" if variant == "plain" else "plain"
        there = () if variant == "plain" else plain_seconds
        rows.append(row(f"train_step/{variant}", seconds, baseline, there, error, None, peak, note))
        yield Result(rows, facts)
        if variant == "fast":
            facts |= _floor(step, options)
        del step, gradients
        if options.device.type == "cuda":
            torch.cuda.empty_cache()
    yield Result(rows, facts)


def _floor(step: Step, options: Options) -> dict[str, Any]:
    """Operations and bytes of the networks of a step, and the time both must take at measured rates."""
    model, scale, batch = step.simulator, step.scale, step.batch
    with torch.no_grad():
        previous = model.encoder(batch.context[:, 0], batch.keys, "previous").particles
        current = model.encoder(batch.context[:, 1], batch.keys, "current").particles
    counts = edge_counts(model.dynamics, previous, current)
    parts = [
        *encoder_layers(model.encoder, scale.image, scale.image, 2),
        *dynamics_layers(model.dynamics, counts) * scale.steps,
        *renderer_layers(model.renderer, scale.rays * scale.steps),
    ]
    amount = work(parts)
    size = options.pick(8192, 4096, 256)
    rates = {name: gemm_rate(options.device, kind, size) for name, kind in _KINDS.items()}
    facts: dict[str, Any] = {"operations": TRAINING * amount.operations, "bytes in float32": TRAINING * amount.bytes}
    moved = copy_rate(options.device, options.pick(1 << 30, 1 << 28, 1 << 20))
    facts["copied_bytes_per_second"] = moved
    for name, rate in rates.items():
        facts[f"{name} operations_per_second"] = rate
        facts[f"{name} floor_seconds"] = TRAINING * amount.operations / rate
    return facts


_KINDS = {"float32": torch.float32, "bf16": torch.bfloat16}


def dynamics(options: Options) -> Iterator[Result]:
    """Steps of the graph network at inference: as it is, in bf16, and with fixed shapes and torch.compile."""
    rows: list[Row] = []
    facts: dict[str, Any] = {}
    for count in options.pick((16384, 131072), (4096,), (64,)):
        nodes = options.pick(1024, 512, 8)
        small = scaling_suite.TINY if options.size == "tiny" else {}
        previous, current = (p.to(options.device) for p in two_frames(count))
        # Compiling C++ takes minutes on a CPU and says nothing of a GPU: there, fixed shapes are rehearsed uncompiled.
        fixed = {"edge_capacity": EDGES_PER_NODE * nodes, "compile": options.device.type == "cuda"}
        eager: list[float] = []
        for name, changes, dtype in (
            ("eager", {}, None),
            ("eager, bf16", {}, torch.bfloat16),
            ("compiled", fixed, None),
            ("compiled, bf16", fixed, torch.bfloat16),
        ):
            torch.manual_seed(0)
            values = {**small, "num_abstract_nodes": nodes, **changes}
            try:
                model = stages.build("dynamics/hierarchical_gnn", "mujoco", **values).to(options.device).eval()
                call = _step_call(model, previous, current, dtype)
                seconds = interleaved({"step": call}, options.repeats, options.device)["step"]
                peak = device_peak(call, options.device)
            except Exception as error:
                if name == "eager":
                    raise
                rows.append(row(f"{count}/{name}", note=f"failed: {type(error).__name__}: {str(error)[:200]}"))
                facts[f"{count} {name} failed"] = traceback.format_exc()
                yield Result(rows, facts)
                continue
            if name == "eager":
                eager = seconds
            rows.append(row(f"{count}/{name}", seconds, "" if name == "eager" else "eager", eager, peak_bytes=peak))
            yield Result(rows, facts)


def _step_call(
    model: torch.nn.Module, previous: Particles, current: Particles, dtype: torch.dtype | None
) -> Callable[[], None]:
    def call() -> None:
        device = current.positions.device.type
        with torch.no_grad(), nullcontext() if dtype is None else torch.autocast(device, dtype):
            model(previous, current, None, KEYS, 0)

    return call


def frames(options: Options) -> Iterator[Result]:
    """A 128x128 frame of 16,384 particles by surface and by the volume renderer, in float32 and bf16."""
    device = options.device
    count, size = options.pick((16384, 128), (4096, 64), (64, 4))
    particles, rays = surface_particles(count).to(device), picture_rays(size).to(device)
    rows = []
    names = {"surface": "surface", "point_nerf": options.pick("point_nerf", "point_nerf", "point_nerf_small")}
    baseline: list[float] = []
    for kind, option in reversed(names.items()):
        torch.manual_seed(0)
        model = stages.build(f"renderer/{option}", "mujoco").to(device).eval()
        colors: dict[str, Tensor] = {}
        for name, dtype in (("float32", None), ("bf16", torch.bfloat16)):

            def call(model=model, dtype=dtype, name=name, colors=colors) -> None:
                with torch.no_grad(), nullcontext() if dtype is None else torch.autocast(device.type, dtype):
                    colors[name] = model(particles, rays, None).rgbs

            seconds = interleaved({"frame": call}, options.repeats, device)["frame"]
            baseline = baseline or seconds
            error = float((colors[name].float() - colors["float32"].float()).square().mean().sqrt())
            note = f"{size}x{size}, {count} particles, untrained; RMS difference of colour to float32"
            peak = device_peak(call, device)
            rows.append(row(f"{kind}/{name}", seconds, "point_nerf, float32", baseline, error, None, peak, note))
            yield Result(rows)


def memory(options: Options) -> Iterator[Result]:
    """A training step and a rollout with 2^17 particles: allocated memory."""
    if options.size == "tiny":
        scale, count = replace(TINY, particles=128), 128
    else:
        # 512x512 pixels, so that there are that many particles to take; everything else as in the paper.
        scale, count = Scale(512, 131072, 1024, 6, 256), 131072
    step = Step("saving", scale, options.device)
    seconds = interleaved({"step": step}, 1, options.device)["step"]
    peak = device_peak(step, options.device)
    rows = [row(f"training step/{count}", seconds, peak_bytes=peak, note="activations computed again; one clip")]
    yield Result(rows)
    del step
    if options.size != "tiny":
        call = scaling_suite.roll_out_and_render(count, 3, 128, options.device.type)
        peak = device_peak(call, options.device)
        seconds = interleaved({"rollout": call}, 1, options.device)["rollout"]
        rows.append(row(f"3 steps and a frame/{count}", seconds, peak_bytes=peak, note=f"all finite: {call()}"))
        yield Result(rows)


def scaling(options: Options) -> Iterator[Result]:
    """The scaling suite on this device."""
    yield scaling_suite.run(replace(options, repeats=max(1, options.repeats // 2)))
