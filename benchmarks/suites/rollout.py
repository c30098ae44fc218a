"""From two frames to a video: encode, roll out, render; wall time of each part, and whether all numbers are finite."""

from pathlib import Path

import torch

from benchmarks import plots, stages
from benchmarks.measuring import Options, Result, Row, row, seconds_now
from benchmarks.models import Model, load_models
from benchmarks.worlds import video_batch
from vpd_lightning.simulator import Scene, Simulator
from vpd_lightning.types import Cameras


def run(options: Options) -> Result:
    """Roll out the given checkpoints, or untrained stages where there are none."""
    models = load_models(options)
    rows: list[Row] = []
    for name, model in models.items():
        rows += _rows(name, model, options)
    if not models:
        rows += _untrained(options)
    return Result(rows)


def _rows(name: str, model: Model, options: Options) -> list[Row]:
    steps, judged = options.pick(32, 8, 2), options.pick(8, 8, 2)  # recordings may end before the rollout does
    clip = model.clip(judged)
    views = model.input_views
    camera = clip.target_cameras[0][views[:1]].to(options.device)
    rgb, depth = clip.rgb[:, views].to(options.device), clip.depth[:, views].to(options.device)

    def encode(simulator: Simulator) -> Scene:
        return simulator.encode(rgb, depth, clip.cameras[:, views].to(options.device))

    rows = _timed(name, model.simulator, encode, camera, steps, options)
    truth = clip.target_rgb[:judged, views[0]].to(options.device).float() / 255
    states = model.simulator.rollout(encode(model.simulator), judged)
    picture = model.simulator.render(states, camera)[:, 0]
    error = (picture - truth).square().mean(dim=(1, 2, 3)).clamp(min=1e-10)
    psnr = float((-10 * error.log10()).mean())
    whole = rows[-1]
    rows[-1] = Row(
        **{**vars(whole), "psnr": psnr, "note": f"{whole.note}; PSNR of input view {views[0]}, {judged} steps"}
    )
    return rows


def _untrained(options: Options) -> list[Row]:
    size, steps = options.pick(128, 64, 32), options.pick(8, 4, 2)
    count = options.pick(4096, 1024, 64)
    simulator = stages.build_simulator(
        "mujoco",
        ("unet_small", {"num_particles": count}),
        ("hierarchical_gnn_small", {}),
        ("surface", {}),
    ).to(options.device)
    batch = video_batch(size, 1, 1).to(options.device)
    context = batch.context[0]

    def encode(model: Simulator) -> Scene:
        return model.encode(context.rgb, context.depth, context.cameras)

    name = f"untrained, {count} particles, {size}x{size}"
    return _timed(name, simulator, encode, context.cameras[0], steps, options)


def _timed(name: str, simulator: Simulator, encode, camera: Cameras, steps: int, options: Options) -> list[Row]:
    """Encode, roll out and render; three parts and their sum."""
    parts: dict[str, list[float]] = {"encode": [], "roll out": [], "render": [], "whole": []}
    finite = True
    for repeat in range(min(options.repeats, 2) + 1):  # 32 frames are repeats enough
        ticks = [seconds_now(options.device)]
        scene = encode(simulator)
        ticks.append(seconds_now(options.device))
        states = simulator.rollout(scene, steps)
        ticks.append(seconds_now(options.device))
        pictures = simulator.render(states, camera)
        ticks.append(seconds_now(options.device))
        finite &= bool(torch.isfinite(pictures).all()) and all(bool(torch.isfinite(s.positions).all()) for s in states)
        if repeat:
            for part, start, end in zip(parts, ticks[:-1], ticks[1:], strict=False):
                parts[part].append(end - start)
            parts["whole"].append(ticks[-1] - ticks[0])
    if not finite:
        raise AssertionError(f"{name}: a position or a colour of the rollout is not finite")
    note = f"{steps} steps, one view of {camera.height}x{camera.width}, all finite"
    return [row(f"{name}/{part}", seconds, note=note if part == "whole" else "") for part, seconds in parts.items()]


def draw(result: Result, path: Path) -> None:
    """Draw the parts."""
    plots.bars(result.rows, "Encode, roll out, render", path)
