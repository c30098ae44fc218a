"""Tables of predicted pictures, from what ``docs.results.studies.pictures`` wrote."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from vpd_lightning.metrics.registry import DRAWN, metric

_TITLES = {
    "prediction": "prediction",
    "copy_last": "*last frame*",
    "train_mean": "*mean image*",
    **{name: f"*{title}, same renderer*" for name, title in DRAWN.items()},
    "best_constant": "*best constant*",
}
_SCORES = ("psnr", "psnr_moving", "ssim", "flip", "moving_iou")


def picture_runs(content: Mapping[str, Any], path: Path) -> str:
    """One row for each evaluation: means of all scores, the last input frame rendered again, centroids by step."""
    first = next(iter(content.values()))
    steps = list(first["pictures"]["prediction"]["psnr"]["per_step"])
    again = ["last frame again (dB)", "SSIM of it"]
    lines = _head(["", *(metric(name).label for name in _SCORES), *again, *(f"centroid {step} (cm)" for step in steps)])
    for name, row in content.items():
        cells = [_shown(row["pictures"]["prediction"], score) for score in _SCORES]
        cells += [f"{row['reconstruction'][score]:.{digits}f}" for score, digits in (("psnr", 1), ("ssim", 3))]
        centroid = row["centroid_error"].get("prediction", {})
        lines.append(_row(name, [*cells, *(_centimetres(centroid.get(step)) for step in steps)]))
    for source in list(_TITLES)[1:]:
        # Of other motions each model draws its own picture: what is known of them is shown by horizon.
        pictures = first["pictures"].get(source, {}) if source in ("copy_last", "train_mean") else {}
        centroid = first["centroid_error"].get(source, {})
        if pictures or centroid:
            cells = [_shown(pictures, score) for score in _SCORES]
            cells += ["", "", *(_centimetres(centroid.get(step)) for step in steps)]
            lines.append(_row(_TITLES[source].replace(", same renderer", ""), cells))
    return "\n".join(lines)


def picture_horizons(content: Mapping[str, Any], path: Path) -> str:
    """Each score after some steps, for the first evaluation and all that it is compared with."""
    row = next(iter(content.values()))
    pictures = row["pictures"]
    steps = list(pictures["prediction"]["psnr"]["per_step"])
    lines = _head(["", "", "mean", *(f"step {step}" for step in steps)], 2)
    for score in _SCORES:
        if score not in pictures["prediction"]:
            continue
        info = metric(score)
        for source in (source for source in _TITLES if score in pictures.get(source, {})):
            found = pictures[source][score]
            cells = [info.shown(found["mean"]), *(info.shown(found["per_step"][step]) for step in steps)]
            lines.append(
                f"| {info.label if source == 'prediction' else ''} | {_TITLES[source]} | {' | '.join(cells)} |"
            )
    return "\n".join(lines)


def _shown(pictures: Mapping[str, Any], score: str) -> str:
    return metric(score).shown(pictures[score]["mean"]) if score in pictures else ""


def _centimetres(value: float | None) -> str:
    return "" if value is None else f"{value:.1f}"


def _row(name: str, cells: Iterable[str]) -> str:
    return f"| {name} | {' | '.join(cells)} |"


def _head(titles: list[str], num_words: int = 1) -> list[str]:
    return [_row(titles[0], titles[1:]), "|" + "---|" * num_words + "---:|" * (len(titles) - num_words)]
