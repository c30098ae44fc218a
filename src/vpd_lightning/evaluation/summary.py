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
        *_seen_lines(metrics),
        "",
        f"{'':24}{'model':>9}{'copy last':>11}{'train mean':>12}{'gain':>8}",
        _image_line("PSNR (dB)", metrics, "psnr", 2),
        _image_line("  moving pixels (dB)", metrics, "psnr_moving", 2),
        _image_line("SSIM", metrics, "ssim", 3),
        _image_line("sharpness (truth: 1)", metrics, "sharpness", 2, has_gain=False),
        *_other_lines(metrics),
    ]
    if metrics["motion"]:
        lines += ["", *_motion_lines(metrics["motion"], protocol["num_steps"])]
        lines += _event_lines(metrics["events"])
    if metrics["long_rollout"]:
        lines += ["", *_long_lines(metrics["long_rollout"])]
    return lines


def _seen_lines(metrics: Mapping[str, Any]) -> list[str]:
    """Say whether a training saw what is evaluated, where it did, or where nobody knows."""
    seen = metrics.get("seen_in_training") or {"trajectories": None}
    if seen["trajectories"] is None:
        return ["whether these trajectories were trained on is not known: the checkpoint does not say"]
    if not seen["trajectories"]:
        return []
    return [f"TRAINED ON: {seen['trajectories']} of these {seen['of']} trajectories, so this says little of new ones"]


def _other_lines(metrics: Mapping[str, Any]) -> list[str]:
    reconstruction, native = metrics["reconstruction"], metrics["native"]
    lines = [
        f"reconstruction of the last input frame: PSNR {_number(reconstruction['psnr'], 2)} dB, "
        f"SSIM {_number(reconstruction['ssim'], 3)}"
    ]
    if native:
        lines.append(
            f"at its own {native['resolution']}x{native['resolution']} pixels, against the truth made as small: PSNR "
            f"{_number(native['psnr'], 2)} dB, SSIM {_number(native['ssim'], 3)}"
        )
    parts = [("Chamfer", metrics["chamfer"]), ("deepest particle in floor or bodies", metrics["penetration"])]
    known = [f"{name} {_number(_scaled(block['mean'], 100), 2)} cm" for name, block in parts if block]
    return [*lines, "; ".join(known)] if known else lines


def horizons(num_steps: int) -> list[int]:
    """The steps that a table shows: 1, 4, 8, 16, 32, ... and the last."""
    chosen = [1]
    step = 4
    while step < num_steps:
        chosen.append(step)
        step *= 2
    return [*chosen, num_steps] if num_steps > 1 else chosen


def _image_line(label: str, metrics: Mapping[str, Any], name: str, digits: int, *, has_gain: bool = True) -> str:
    model = metrics[name]["mean"]
    references = [metrics["references"][system][name]["mean"] for system in ("copy_last", "train_mean")]
    known = [value for value in references if value is not None]
    gain = f"{model - max(known):+8.{digits}f}" if model is not None and known else f"{'-':>8}"
    gain = gain if has_gain else ""
    copy, mean = (_number(value, digits) for value in references)
    return f"{label:24}{_number(model, digits):>9}{copy:>11}{mean:>12}{gain}"


def _motion_lines(motion: Mapping[str, Any], num_steps: int) -> list[str]:
    steps = horizons(num_steps)
    rows: list[tuple[str, str, float, int]] = [
        ("centroid error (cm)", "centroid_error", 100.0, 1),
        ("  best constant (cm)", "centroid_error_constant", 100.0, 1),
        ("  nothing moves (cm)", "centroid_error_copy", 100.0, 1),
        ("  velocity kept (cm)", "centroid_error_velocity", 100.0, 1),
        ("  model / constant", "centroid_error_over_constant", 1.0, 2),
        ("particle error (cm)", "particle_error", 100.0, 1),
        ("orientation error (deg)", "orientation_error", 1.0, 1),
        ("velocity error (cm/s)", "velocity_error", 100.0, 1),
        ("block size / start", "size_ratio", 1.0, 2),
        ("distance to surface (cm)", "body_chamfer", 100.0, 1),
    ]
    of_some = ("body_chamfer", "size_ratio", "orientation_error")  # soft or rigid bodies alone have them
    rows = [row for row in rows if row[1] not in of_some or motion[row[1]]["count"]]
    lines = [f"{'after step':24}" + "".join(f"{step:>9}" for step in steps)]
    for label, name, scale, digits in rows:
        values: Sequence[float | None] = motion[name]["per_step"]
        lines.append(
            f"{label:24}" + "".join(f"{_number(_scaled(values[step - 1], scale), digits):>9}" for step in steps)
        )
    return lines


def _event_lines(events: Mapping[str, Any]) -> list[str]:
    """What is known of contacts and rest; nothing of a set where neither happens."""
    contact, rest = events["contact"], events["rest"]
    lines = []
    if contact["count"]:
        lines.append(
            f"first contact of {contact['count']} falls: {_number(contact['error'], 1)} steps off, "
            f"{_number(_scaled(contact['missed'], 100), 0)}% missed"
        )
    if rest["count"]:
        lines.append(
            f"rest of {rest['count']} bodies: height {_number(_scaled(rest['height_error'], 100), 1)} cm off, "
            f"{_number(_scaled(rest['share_within_5_cm'], 100), 0)}% within 5 cm, still moving at "
            f"{_number(_scaled(rest['speed'], 100), 1)} cm/s"
        )
    return lines


def _long_lines(rollout: Mapping[str, Any]) -> list[str]:
    drift, size, lowest, speed = (
        rollout[name] for name in ("floor_drift", "size_ratio", "lowest_point", "final_speed")
    )
    num_clips = rollout["num_clips"]
    finite = "everything finite" if rollout["finite"] else f"NOT FINITE in {num_clips - rollout['num_finite']} of them"
    return [
        f"{rollout['num_steps']}-step rollout of {num_clips} clips: {finite}",
        f"  floor drift   worst particle {_number(_scaled(drift['max'], 100), 2)} cm; median clip: p99 "
        f"{_number(_scaled(drift['p99'], 100), 2)} cm, median {_number(_scaled(drift['median'], 100), 2)} cm"
        + _share(drift, num_clips),
        f"  block size    {_number(size['min'], 2)} to {_number(size['max'], 2)} of its start; median clip "
        f"{_number(size['median'], 2)} at the end" + _share(size, num_clips),
        f"  lowest point  {_number(lowest['min'], 3)} m" + _share(lowest, num_clips),
        f"  last speed    {_number(_scaled(speed['median'], 100), 2)} cm/step over the last 10 steps, median clip"
        + _share(speed, num_clips),
    ]


def _share(block: Mapping[str, Any], num_clips: int) -> str:
    """Say over how many clips a block speaks, where that is not all."""
    return "" if block["count"] == num_clips else f" ({block['count']} of {num_clips} clips)"


def _scaled(value: float | None, scale: float) -> float | None:
    return None if value is None else value * scale


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
