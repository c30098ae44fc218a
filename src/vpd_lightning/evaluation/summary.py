"""The few lines a person reads after an evaluation."""

from collections.abc import Mapping, Sequence
from typing import Any


def summary_lines(metrics: Mapping[str, Any]) -> list[str]:
    """Format ``metrics.json`` as a compact table: model against references, motion, long rollout."""
    protocol = metrics["protocol"]
    lines = [
        f"{protocol['split']}: {protocol['num_trajectories']} trajectories, {protocol['num_clips']} clips, "
        f"{protocol['num_steps']} steps, {protocol['num_views']} views"
        + ("" if metrics["finite"] else "  (NOT FINITE: some predictions are NaN or infinite)"),
        "",
        f"{'':24}{'model':>9}{'copy last':>11}{'train mean':>12}{'gain':>8}",
        _image_line("PSNR (dB)", metrics, "psnr", 2),
        _image_line("  moving pixels (dB)", metrics, "psnr_moving", 2),
        _image_line("SSIM", metrics, "ssim", 3),
    ]
    reconstruction = metrics["reconstruction"]
    lines.append(
        f"reconstruction of the last input frame: PSNR {_number(reconstruction['psnr'], 2)} dB, "
        f"SSIM {_number(reconstruction['ssim'], 3)}; Chamfer {_number(_scaled(metrics['chamfer']['mean'], 100), 2)} cm"
    )
    if metrics["motion"]:
        lines += ["", *_motion_lines(metrics["motion"], protocol["num_steps"])]
    if metrics["long_rollout"]:
        lines += ["", *_long_lines(metrics["long_rollout"])]
    return lines


def horizons(num_steps: int) -> list[int]:
    """The steps that a table shows: 1, 4, 8, 16, 32, ... and the last."""
    chosen = [1]
    step = 4
    while step < num_steps:
        chosen.append(step)
        step *= 2
    return [*chosen, num_steps] if num_steps > 1 else chosen


def _image_line(label: str, metrics: Mapping[str, Any], name: str, digits: int) -> str:
    model = metrics[name]["mean"]
    references = [metrics["references"][system][name]["mean"] for system in ("copy_last", "train_mean")]
    known = [value for value in references if value is not None]
    gain = f"{model - max(known):+8.{digits}f}" if model is not None and known else f"{'-':>8}"
    copy, mean = (_number(value, digits) for value in references)
    return f"{label:24}{_number(model, digits):>9}{copy:>11}{mean:>12}{gain}"


def _motion_lines(motion: Mapping[str, Any], num_steps: int) -> list[str]:
    steps = horizons(num_steps)
    rows: list[tuple[str, str, float, int]] = [
        ("centroid error (cm)", "centroid_error", 100.0, 1),
        ("  best constant (cm)", "centroid_error_constant", 100.0, 1),
        ("  nothing moves (cm)", "centroid_error_copy", 100.0, 1),
        ("  model / constant", "centroid_error_over_constant", 1.0, 2),
        ("particle error (cm)", "particle_error", 100.0, 1),
        ("block size / start", "size_ratio", 1.0, 2),
    ]
    lines = [f"{'after step':24}" + "".join(f"{step:>9}" for step in steps)]
    for label, name, scale, digits in rows:
        values: Sequence[float | None] = motion[name]["per_step"]
        lines.append(
            f"{label:24}" + "".join(f"{_number(_scaled(values[step - 1], scale), digits):>9}" for step in steps)
        )
    return lines


def _long_lines(rollout: Mapping[str, Any]) -> list[str]:
    drift, size = rollout["floor_drift"], rollout["size_ratio"]
    return [
        f"{rollout['num_steps']}-step rollout of {rollout['num_clips']} clips: "
        + ("everything finite" if rollout["finite"] else "NOT FINITE"),
        f"  floor drift   median {_number(_scaled(drift['median'], 100), 2)} cm, p99 "
        f"{_number(_scaled(drift['p99'], 100), 2)} cm, worst particle {_number(_scaled(drift['max'], 100), 2)} cm",
        f"  block size    {_number(size['min'], 2)} to {_number(size['max'], 2)} of its start "
        f"(median at the end {_number(size['median'], 2)})",
        f"  lowest point  {_number(rollout['lowest_point']['min'], 3)} m; speed over the last 10 steps "
        f"{_number(_scaled(rollout['final_speed']['median'], 100), 2)} cm/step (median)",
    ]


def _scaled(value: float | None, scale: float) -> float | None:
    return None if value is None else value * scale


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
