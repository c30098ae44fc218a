"""The few lines a person reads after an evaluation."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from vpd_lightning.evaluation.report import ratio_name
from vpd_lightning.metrics.metric_info import MetricInfo
from vpd_lightning.metrics.registry import (
    DRAWN,
    REFERENCES,
    blocks,
    image_metrics,
    motion_metrics,
    scores,
    still_scores,
)


def summary_lines(metrics: Mapping[str, Any]) -> list[str]:
    """Format ``metrics.json`` as a compact table: model against references, motion, long rollout."""
    protocol = metrics["protocol"]
    lines = [
        f"{protocol['split']}: {protocol['num_trajectories']} trajectories, {protocol['num_clips']} clips, "
        f"{protocol['num_steps']} steps, {protocol['num_views']} views"
        + ("" if metrics["finite"] else "  (NOT FINITE: some predictions are NaN or infinite)"),
        *seen_lines(metrics),
        "",
        *_image_lines(metrics),
        *_unmeasured_lines(metrics),
        *_drawn_lines(metrics),
        *_other_lines(metrics),
    ]
    if metrics["motion"]:
        lines += ["", *_motion_lines(metrics["motion"], protocol["num_steps"])]
        lines += _event_lines(metrics["events"])
    if metrics["long_rollout"]:
        lines += ["", *_long_lines(metrics["long_rollout"])]
    return lines


def seen_lines(metrics: Mapping[str, Any]) -> list[str]:
    """Say whether a training saw what is evaluated, where it did, or where nobody knows."""
    seen = metrics.get("seen_in_training") or {"trajectories": None}
    if seen["trajectories"] is None:
        return ["whether these trajectories were trained on is not known: the checkpoint does not say"]
    if not seen["trajectories"]:
        return []
    return [f"TRAINED ON: {seen['trajectories']} of these {seen['of']} trajectories, so this says little of new ones"]


def _other_lines(metrics: Mapping[str, Any]) -> list[str]:
    native = metrics["native"]
    lines = [f"reconstruction of the last input frame: {_spoken(metrics['reconstruction'])}"]
    if native:
        size = f"{native['resolution']}x{native['resolution']}"
        lines.append(f"at its own {size} pixels, against the truth made as small: {_spoken(native)}")
    known = [info.spoken(metrics[info.name]["mean"]) for info in blocks() if info.in_summary and metrics[info.name]]
    return [*lines, "; ".join(known)] if known else lines


def _spoken(means: Mapping[str, Any]) -> str:
    return ", ".join(info.spoken(means[info.name]) for info in still_scores() if means.get(info.name) is not None)


def horizons(num_steps: int) -> list[int]:
    """The steps that a table shows: 1, 4, 8, 16, 32, ... and the last."""
    chosen = [1]
    step = 4
    while step < num_steps:
        chosen.append(step)
        step *= 2
    return [*chosen, num_steps] if num_steps > 1 else chosen


def _image_lines(metrics: Mapping[str, Any]) -> list[str]:
    infos = [info for info in image_metrics() if info.in_summary and info.name in metrics]
    width = _label_width(info.label for info in infos)
    return [
        f"{'':{width}}{'model':>9}{'copy last':>11}{'train mean':>12}{'gain':>8}",
        *(_image_line(info, width, metrics) for info in infos),
    ]


def _drawn_lines(metrics: Mapping[str, Any]) -> list[str]:
    """Other motions drawn by the same renderer, where they were asked for."""
    drawn = metrics.get("drawn")
    if not drawn:
        asked = metrics["protocol"].get("draw_references")
        return ["other motions were not drawn: they need particles, and ground truth of every clip"] if asked else []
    names = [name for name in DRAWN if name in drawn]
    infos = [info for info in scores() if info.in_summary and info.name in metrics]
    width = _label_width(info.label for info in infos)
    lines = ["", f"{'same renderer':{width}}{'model':>9}" + "".join(f"{DRAWN[name]:>20}" for name in names)]
    for info in infos:
        means = [info.shown(drawn[name][info.name]["mean"]) for name in names]
        lines.append(
            f"{info.label:{width}}{info.shown(metrics[info.name]['mean']):>9}"
            + "".join(f"{mean:>20}" for mean in means)
        )
    return lines


def _unmeasured_lines(metrics: Mapping[str, Any]) -> list[str]:
    """Say why a metric has no value, where what it needs was missing."""
    return [
        f"{info.title} was not measured: {info.why_missing}."
        for info in image_metrics()
        if info.why_missing and info.name in metrics and metrics[info.name]["mean"] is None
    ]


def _image_line(info: MetricInfo, width: int, metrics: Mapping[str, Any]) -> str:
    model = metrics[info.name]["mean"]
    references = [metrics["references"][source][info.name]["mean"] for source in REFERENCES]
    copy, mean = (info.shown(value) for value in references)
    return f"{info.label:{width}}{info.shown(model):>9}{copy:>11}{mean:>12}{gain(info, model, references)}"


def gain(info: MetricInfo, model: float | None, references: Sequence[float | None]) -> str:
    """By how much the model is better than the better reference; nothing where no distance says so."""
    known = [value for value in references if value is not None]
    if not info.is_score:
        return ""
    if model is None or not known:
        return f"{'-':>8}"
    best = min(known, key=info.distance)
    return f"{info.scale * (info.distance(best) - info.distance(model)):+8.{info.digits}f}"


def _motion_lines(motion: Mapping[str, Any], num_steps: int) -> list[str]:
    steps = horizons(num_steps)
    rows = [row for info in motion_metrics() if info.in_summary for row in motion_rows(info, motion)]
    width = _label_width(label for label, _ in rows)
    lines = [f"{'after step':{width}}" + "".join(f"{step:>9}" for step in steps)]
    return lines + [f"{label:{width}}" + "".join(f"{cells[step - 1]:>9}" for step in steps) for label, cells in rows]


def motion_rows(info: MetricInfo, motion: Mapping[str, Any]) -> list[tuple[str, list[str]]]:
    """A metric by step, those of its references indented, and behind them the ratio to one that sees no input."""
    if not motion[info.name]["count"]:  # rigid or soft bodies alone have some of them
        return []
    cells = [info.shown(value) for value in motion[info.name]["per_step"]]
    if info.reference_of is None:
        return [(info.label, cells)]
    rows = [(f"  {info.label}", cells)]
    ratios = motion.get(ratio_name(info))
    if ratios is not None and not info.sees_input:
        label = f"  model / {info.name.removeprefix(f'{info.reference_of}_')}"
        rows.append((label, ["-" if value is None else f"{value:.2f}" for value in ratios["per_step"]]))
    return rows


def _label_width(labels: Iterable[str]) -> int:
    return max((len(label) for label in labels), default=0) + 1


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
    """Say how many clips a block averages over, where that is not all."""
    return "" if block["count"] == num_clips else f" ({block['count']} of {num_clips} clips)"


def _scaled(value: float | None, scale: float) -> float | None:
    return None if value is None else value * scale


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
