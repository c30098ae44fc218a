"""The figures that a model card shows, beside both references."""

from collections.abc import Mapping
from typing import Any

from vpd_lightning.metrics.metric_info import MetricInfo
from vpd_lightning.metrics.registry import (
    REFERENCES,
    blocks,
    image_metrics,
    metric,
    referenced,
    references_of,
    still_scores,
)


def figure_lines(metrics: Mapping[str, Any]) -> list[str]:
    """Return the table of figures with both references, and the lines under it."""
    protocol = metrics["protocol"]
    seen = (metrics.get("seen_in_training") or {}).get("trajectories")
    unseen = " that no training saw" if seen == 0 else ""
    lines = [
        f"Split `{protocol['split']}`: {protocol['num_trajectories']} trajectories{unseen}, "
        f"{protocol['num_clips']} clips, {protocol['num_steps']} predicted steps, {protocol['num_views']} cameras "
        f"({len(protocol['input_views'])} of them inputs). Means over images with 95 % bootstrap intervals over "
        "trajectories, beside two references: the last input frame repeated, and the mean image of each camera over "
        "the training set. `metrics.json` has the rest.",
        *_doubt(seen),
        "",
        "| | model | 95 % interval | last frame repeated | training mean |",
        "|---|---:|---:|---:|---:|",
    ]
    lines += [row for info in image_metrics() for row in _image_rows(metrics, info)]
    lines += [row for info in (*blocks(), *referenced()) for row in _single_row(metrics, info)]
    for info in referenced():
        others = _blind_references(info, metrics)
        if others:
            words = " and ".join(other.spoken(found) for other, found in others.items())
            count = "two references" if len(others) == 2 else "references"
            lines += ["", f"{short_title(info).capitalize()} of {count} that see nothing: {words}."]
    native = metrics.get("native")
    if native:
        words = ", ".join(info.spoken(native.get(info.name)) for info in still_scores() if info.name in native)
        lines += ["", f"At the resolution it was trained at ({native['resolution']} pixels): {words}."]
    return lines


def _doubt(seen: int | None) -> list[str]:
    """A line where it is not sure that the figures are about trajectories that no training saw."""
    if seen is None:
        return ["", "Whether a training saw some of these trajectories is unknown: its checkpoint did not say."]
    return ["", f"**{seen} of these trajectories were trained on.**"] if seen else []


def short_title(info: MetricInfo) -> str:
    """The title within a sentence that says whose it is."""
    return info.title.removesuffix(" of bodies")


def beaten_by(metrics: Mapping[str, Any], name: str) -> list[str]:
    """Return the references whose mean of a score of images is as good as the model's, or better."""
    info = metric(name)
    own = (metrics.get(info.name) or {}).get("mean")
    words = {"copy_last": "repeating the last frame", "train_mean": "the training mean"}
    means = {source: (metrics["references"][source].get(info.name) or {}).get("mean") for source in REFERENCES}
    if own is None:
        return []
    known = {source: mean for source, mean in means.items() if mean is not None}
    return [words[source] for source, mean in known.items() if info.distance(mean) <= info.distance(own)]


def beaten_in_motion_by(metrics: Mapping[str, Any], name: str) -> list[str]:
    """Return the references of the bodies' motion whose error is as low as the model's, or lower."""
    info = metric(name)
    summary = info.summary(metrics)
    if summary is None:
        return []
    return [other.title for other, error in _blind_references(info, metrics).items() if error <= summary["mean"]]


def _blind_references(info: MetricInfo, metrics: Mapping[str, Any]) -> dict[MetricInfo, float]:
    """Mean error of what does not look at the input, as far as known."""
    summaries = {other: other.summary(metrics) for other in references_of(info) if not other.sees_input}
    return {other: summary["mean"] for other, summary in summaries.items() if summary is not None}


def _image_rows(metrics: Mapping[str, Any], info: MetricInfo) -> list[str]:
    name, digits = info.name, info.digits
    if (metrics.get(name) or {}).get("mean") is None:
        return []
    rows = []
    references = [metrics["references"][reference].get(name) or {} for reference in REFERENCES]
    picks = [("", "mean")]
    if metrics[name].get("other_views") is not None:
        picks += [(", input cameras", "input_views"), (", other cameras", "other_views")]
    for suffix, key in picks:
        interval = _interval(metrics[name], 1.0, digits) if key == "mean" else ""
        cells = [_number(metrics[name][key], digits), interval, *(_number(r.get(key), digits) for r in references)]
        rows.append(f"| {info.label}{suffix} | {' | '.join(cells)} |")
    return rows


def _single_row(metrics: Mapping[str, Any], info: MetricInfo) -> list[str]:
    block = info.summary(metrics)
    if block is None:
        return []
    return [f"| {info.label} | {info.shown(block['mean'])} | {_interval(block, info.scale, info.digits)} | | |"]


def _interval(block: Mapping[str, Any], scale: float, digits: int) -> str:
    ends = block.get("ci95")
    if not ends or None in ends:
        return ""
    return " to ".join(_number(scale * end, digits) for end in ends)


def _number(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"
