"""The figures that a model card shows, beside both references."""

from collections.abc import Mapping
from typing import Any

REFERENCES = ("copy_last", "train_mean")
SCORES = (("PSNR (dB)", "psnr", 2), ("PSNR of moving pixels (dB)", "psnr_moving", 2), ("SSIM", "ssim", 3))
"""Label, name in ``metrics.json`` and digits of what is higher where a prediction is better."""


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
    lines += [row for label, name, digits in SCORES for row in _image_rows(metrics, label, name, digits)]
    lines += _image_rows(metrics, "sharpness (truth: 1)", "sharpness", 2)
    lines += _single_row("Chamfer distance (cm)", metrics.get("chamfer"), 100.0, 2)
    lines += _single_row("deepest particle in floor or bodies (cm)", metrics.get("penetration"), 100.0, 2)
    motion = metrics.get("motion") or {}
    lines += _single_row("centroid error of bodies (cm)", motion.get("centroid_error"), 100.0, 1)
    others = _centroid_references(motion)
    if others:
        words = " and ".join(f"{what} {100 * error:.1f} cm" for what, error in others.items())
        lines += ["", f"Centroid error of two references that see nothing: {words}."]
    native = metrics.get("native")
    if native:
        value = f"{_number(native['psnr'], 2)} dB, SSIM {_number(native['ssim'], 3)}"
        lines += ["", f"At the resolution it was trained at ({native['resolution']} pixels): PSNR {value}."]
    return lines


def _doubt(seen: int | None) -> list[str]:
    """A line where it is not sure that the figures are about trajectories that no training saw."""
    if seen is None:
        return ["", "Whether a training saw some of these trajectories is unknown: its checkpoint did not say."]
    return ["", f"**{seen} of these trajectories were trained on.**"] if seen else []


def beaten_by(metrics: Mapping[str, Any], name: str) -> list[str]:
    """Return the references whose mean of a figure is as high as the model's, or higher."""
    own = (metrics.get(name) or {}).get("mean")
    words = {"copy_last": "repeating the last frame", "train_mean": "the training mean"}
    means = {reference: metrics["references"][reference][name]["mean"] for reference in REFERENCES}
    return [words[key] for key, mean in means.items() if own is not None and mean is not None and mean >= own]


def beaten_in_motion_by(metrics: Mapping[str, Any]) -> list[str]:
    """Return the references of the bodies' motion whose centroid error is as low as the model's, or lower."""
    motion = metrics.get("motion") or {}
    own = (motion.get("centroid_error") or {}).get("mean")
    return [what for what, error in _centroid_references(motion).items() if own is not None and error <= own]


def _centroid_references(motion: Mapping[str, Any]) -> dict[str, float]:
    """Mean centroid error in metres of what does not look at the input, as far as known."""
    names = {"no motion": "centroid_error_copy", "the best constant displacement": "centroid_error_constant"}
    means = {what: (motion.get(name) or {}).get("mean") for what, name in names.items()}
    return {what: mean for what, mean in means.items() if mean is not None}


def _image_rows(metrics: Mapping[str, Any], label: str, name: str, digits: int) -> list[str]:
    if not metrics.get(name):
        return []
    rows = []
    references = [metrics["references"][reference][name] for reference in REFERENCES]
    picks = [("", "mean")]
    if metrics[name].get("other_views") is not None:
        picks += [(", input cameras", "input_views"), (", other cameras", "other_views")]
    for suffix, key in picks:
        interval = _interval(metrics[name], 1.0, digits) if key == "mean" else ""
        cells = [_number(metrics[name][key], digits), interval, *(_number(r.get(key), digits) for r in references)]
        rows.append(f"| {label}{suffix} | {' | '.join(cells)} |")
    return rows


def _single_row(label: str, block: Mapping[str, Any] | None, scale: float, digits: int) -> list[str]:
    if not block or block.get("mean") is None:
        return []
    return [f"| {label} | {_number(scale * block['mean'], digits)} | {_interval(block, scale, digits)} | | |"]


def _interval(block: Mapping[str, Any], scale: float, digits: int) -> str:
    ends = block.get("ci95")
    if not ends or None in ends:
        return ""
    return " to ".join(_number(scale * end, digits) for end in ends)


def _number(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"
