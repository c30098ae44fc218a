"""Tables of predicted pictures, from what ``docs.results.studies.pictures`` wrote."""

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from vpd_lightning.metrics.registry import DRAWN, NOTHING_MOVES, TRUE_VELOCITY, metric

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
    return "\n".join([*_head(["", *_run_titles(content)]), *(_row(name, cells) for name, cells in _run_rows(content))])


def picture_sets(content: Mapping[str, Any], path: Path) -> str:
    """Several data sets below each other; evaluations are named ``DATA SET: MODEL``. Scores: input / other cameras."""
    sets: dict[str, dict[str, Any]] = {}
    for name, row in content.items():
        data_set, _, model = name.partition(": ")
        sets.setdefault(data_set, {})[model] = row
    later = _steps(content)[-2:]
    titles = [*(metric(name).label for name in _SCORES), *(f"centroid {step} (cm)" for step in later), "updates"]
    lines = _head(["", "", *titles], 2)

    def add(words: list[str], pictures: Mapping[str, Any], centroid: Mapping[str, float], updates: str) -> None:
        scores = (_by_cameras(pictures, score) for score in _SCORES)
        lines.append(
            _row(words[0], [words[1], *scores, *(_centimetres(centroid.get(step)) for step in later), updates])
        )

    for data_set, rows in sets.items():
        for number, (name, row) in enumerate(rows.items()):
            centroid = row["centroid_error"].get("prediction", {})
            add(["" if number else data_set, name], row["pictures"]["prediction"], centroid, f"{row['step']:,}")
        first = next(iter(rows.values()))
        for source in ("copy_last", "train_mean", NOTHING_MOVES, TRUE_VELOCITY, "best_constant"):
            known = source in ("copy_last", "train_mean")
            pictures = first["pictures"].get(source, {}) if known else {}
            centroid = first["centroid_error"].get(source, {})
            if pictures or centroid:
                add(["", _TITLES[source].replace(", same renderer", "")], pictures, centroid, "")
    return "\n".join(lines)


def _steps(content: Mapping[str, Any]) -> list[str]:
    return list(next(iter(content.values()))["pictures"]["prediction"]["psnr"]["per_step"])


def _run_titles(content: Mapping[str, Any]) -> list[str]:
    again = ["last frame again (dB)", "SSIM of it"]
    return [*(metric(name).label for name in _SCORES), *again, *(f"centroid {step} (cm)" for step in _steps(content))]


def _run_rows(content: Mapping[str, Any]) -> Iterator[tuple[str, list[str]]]:
    """Yield name and cells of each evaluation, then of what needs no model: on the same data it is the same of all."""
    steps = _steps(content)
    for name, row in content.items():
        again = [f"{row['reconstruction'][score]:.{digits}f}" for score, digits in (("psnr", 1), ("ssim", 3))]
        centroid = row["centroid_error"].get("prediction", {})
        shown = [_shown(row["pictures"]["prediction"], score) for score in _SCORES]
        yield name, [*shown, *again, *(_centimetres(centroid.get(step)) for step in steps)]
    first = next(iter(content.values()))
    for source in list(_TITLES)[1:]:
        # Of other motions each model draws its own picture: what is known of them is shown by horizon.
        pictures = first["pictures"].get(source, {}) if source in ("copy_last", "train_mean") else {}
        centroid = first["centroid_error"].get(source, {})
        if pictures or centroid:
            shown = [_shown(pictures, score) for score in _SCORES]
            cells = [*shown, "", "", *(_centimetres(centroid.get(step)) for step in steps)]
            yield _TITLES[source].replace(", same renderer", ""), cells


def picture_horizons(content: Mapping[str, Any], path: Path) -> str:
    """Each score after some steps, for the first evaluation and all that it is compared with."""
    row = next(iter(content.values()))
    pictures = row["pictures"]
    steps = _steps(content)
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


def _by_cameras(pictures: Mapping[str, Any], score: str) -> str:
    if score not in pictures:
        return ""
    parts = (pictures[score]["input_views"], pictures[score]["other_views"])
    return " / ".join(metric(score).shown(part) for part in parts if part is not None)


def _centimetres(value: float | None) -> str:
    return "" if value is None else f"{value:.1f}"


def _row(name: str, cells: Iterable[str]) -> str:
    return f"| {name} | {' | '.join(cells)} |"


def _head(titles: list[str], num_words: int = 1) -> list[str]:
    return [_row(titles[0], titles[1:]), "|" + "---|" * num_words + "---:|" * (len(titles) - num_words)]
