"""One training step against the paper written plainly: time, memory, agreement, and the distance to the floor."""

from collections import defaultdict
from pathlib import Path

import torch

from benchmarks import plots
from benchmarks.arithmetic import TRAINING, Work, dynamics_layers, edge_counts, encoder_layers, renderer_layers, work
from benchmarks.measuring import Options, Result, Row, Stopwatch, copy_rate, device_peak, gemm_rate, row
from benchmarks.memory_probe import peak_of
from benchmarks.plain.neighbors import SEARCH
from benchmarks.training_step import OTHER_RENDERERS, SCALES, STAGES, LiteralStep, Step

VARIANTS = ("plain", "fast", "saving", "bf16", "surface", "surface_bf16", "splat", "splat_bf16")
LITERAL = "literal"
LOSS_TOLERANCE, GRADIENT_TOLERANCE = 1e-5, 1e-4  # relative; float32 sums in another order
NOTES = {
    "fast": "exact tricks alone",
    "saving": "activations computed again in the backward pass",
    "bf16": "autocast to bfloat16; not the same numbers",
    "surface": "another renderer: another loss, so no error",
    LITERAL: "the paper in PyTorch without this package: other weights and draws, so no error",
    "surface_bf16": "another renderer, autocast to bfloat16: another loss, so no error",
    "splat": "another renderer: another loss, so no error",
    "splat_bf16": "another renderer, autocast to bfloat16: another loss, so no error",
}


def run(options: Options) -> Result:
    """Measure all variants in turns.

    Raises:
        AssertionError: an exact variant disagrees with the plain path.
    """
    scale = SCALES[options.size]
    steps = {variant: Step(variant, scale, options.device) for variant in VARIANTS}
    together = {**steps, LITERAL: LiteralStep(scale, options.device)}
    seconds: dict[str, dict[str, list[float]]] = {variant: defaultdict(list) for variant in together}
    for repeat in range(options.repeats + 1):  # the first round warms up
        for variant, step in together.items():
            watch = Stopwatch(options.device)
            step(watch)
            if repeat:
                for name in (*STAGES, "other"):
                    seconds[variant][name].append(watch.seconds.get(name, 0.0))
                seconds[variant]["step"].append(sum(watch.seconds.values()))
    probed = options.pick(
        ("plain", "fast", "saving", "surface"), ("plain", "saving"), ("plain", "saving")
    )  # each takes a process of its own
    peaks = {variant: _peak(variant, step, options) if variant in probed else None for variant, step in steps.items()}
    rows = [row("train_step/plain", seconds["plain"]["step"], peak_bytes=peaks["plain"], note=f"{SEARCH} neighbours")]
    reference = steps["plain"].gradients()
    for variant in VARIANTS[1:]:
        error = None
        note = NOTES[variant]
        if not variant.startswith(OTHER_RENDERERS):
            error = float((steps[variant].gradients() - reference).norm() / reference.norm())
            loss_error = abs(steps[variant].last_loss / steps["plain"].last_loss - 1)
            note += f"; gradients (error) and loss ({loss_error:.0e}) relative to plain"
            if variant in ("fast", "saving") and not (error < GRADIENT_TOLERANCE and loss_error < LOSS_TOLERANCE):
                raise AssertionError(f"{variant} disagrees with plain: gradients {error:.1e}, loss {loss_error:.1e}")
        here, there = seconds[variant]["step"], seconds["plain"]["step"]
        rows.append(row(f"train_step/{variant}", here, "plain", there, error, None, peaks[variant], note))
    literal = seconds[LITERAL]["step"]
    rows.append(row(f"train_step/{LITERAL}", literal, "plain", seconds["plain"]["step"], note=NOTES[LITERAL]))
    for variant in VARIANTS:
        rows.append(row(f"against literal/{variant}", seconds[variant]["step"], LITERAL, literal))
    for stage in (*STAGES, "other"):
        here, there = seconds["fast"][stage], seconds["plain"][stage]
        if max(here) > 0:  # on the plain path the graph is part of the dynamics
            rows.append(row(f"stage/{stage}", here, "plain" if max(there) > 0 else "", there if max(there) > 0 else ()))
    return Result(rows, _floors(steps["fast"], rows, options))


def _peak(variant: str, step: Step, options: Options) -> int | None:
    if options.device.type == "cuda":
        return device_peak(step, options.device)
    return peak_of("training_step:prepared", variant=variant, scale=options.size)["peak_bytes"]


def _floors(step: Step, rows: list[Row], options: Options) -> dict[str, object]:
    """Return operations and bytes of each stage's networks, and how near the measured times are to their floor."""
    simulator, scale, batch = step.simulator, step.scale, step.batch
    with_draws = batch.keys
    previous = simulator.encoder(batch.context[:, 0], with_draws, "previous").particles
    current = simulator.encoder(batch.context[:, 1], with_draws, "current").particles
    counts = edge_counts(simulator.dynamics, previous, current)
    rays = scale.rays * scale.steps

    def several(one: Work) -> Work:
        return Work(one.operations * scale.steps, one.bytes * scale.steps)

    stages = {
        "encode": work(encoder_layers(simulator.encoder, scale.image, scale.image, 2)),
        "dynamics": several(work(dynamics_layers(simulator.dynamics, counts))),
        "render": work(renderer_layers(simulator.renderer, rays)),
    }
    operations, moved = gemm_rate(options.device), copy_rate(options.device)
    facts: dict[str, object] = {
        "gemm_operations_per_second": operations,
        "copied_bytes_per_second": moved,
        "abstract_edges": counts.abstract_to_abstract,
        "particles": int(current.mask.sum()),
    }
    measured = {item.name.split("/")[1]: item.seconds or 0.0 for item in rows if item.name.startswith("stage/")}
    forward = 0.0
    for name, amount in stages.items():
        floor = amount.seconds(operations, moved)
        forward += amount.operations / operations
        facts[f"{name}_operations"], facts[f"{name}_bytes"] = amount.operations, amount.bytes
        facts[f"{name}_floor_seconds"] = floor
        facts[f"{name}_floor_share"] = floor / measured[name] if measured.get(name) else None
    total = TRAINING * forward
    facts["backward_floor_seconds"] = total - forward
    facts["backward_floor_share"] = (total - forward) / measured["backward"]
    fast, plain = (next(r.seconds for r in rows if r.name == f"train_step/{v}") for v in ("fast", "plain"))
    facts["networks_floor_seconds"] = total
    facts["networks_floor_share_fast"] = total / (fast or 1.0)
    facts["networks_floor_share_plain"] = total / (plain or 1.0)
    facts |= _bfloat16_floor(list(stages.values()), rows, moved, options)
    layers = renderer_layers(simulator.renderer, rays, is_plain=True)
    plain_work = several(work(dynamics_layers(simulator.dynamics, counts, is_plain=True)))
    as_written = stages["encode"].operations + plain_work.operations + work(layers).operations
    facts["operations_saved"] = 1 - sum(amount.operations for amount in stages.values()) / as_written
    return facts


def _bfloat16_floor(stages: list[Work], rows: list[Row], moved: float, options: Options) -> dict[str, object]:
    """Return the floor of the step in bfloat16, where numbers are half as long, and how near the step is to it."""
    rate = gemm_rate(options.device, torch.bfloat16)
    halved = [Work(amount.operations, amount.bytes / 2) for amount in stages]
    floor = TRAINING * sum(amount.seconds(rate, moved) for amount in halved)
    bf16, literal = (next(r.seconds for r in rows if r.name == f"train_step/{v}") for v in ("bf16", LITERAL))
    return {
        "bfloat16_gemm_operations_per_second": rate,
        "bfloat16_networks_floor_seconds": floor,
        "bfloat16_networks_floor_share": floor / (bf16 or 1.0),
        "literal_over_bfloat16_networks_floor": (literal or 0.0) / floor,
    }


def draw(result: Result, path: Path) -> None:
    """Draw time and memory of the variants beside the plain path."""
    rows = [item for item in result.rows if item.name.startswith("train_step/")]
    plots.bars(rows, "One training step", path)
