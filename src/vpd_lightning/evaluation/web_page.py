"""``index.html``: one evaluation on one page: films, figures beside those of the references, curves, pictures."""

from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

from vpd_lightning.evaluation.report import step_table
from vpd_lightning.evaluation.summary import gain, horizons, motion_rows, seen_lines, summary_lines
from vpd_lightning.files import AtomicPath
from vpd_lightning.media.html import films, folded, html_page, paragraph, picture, table
from vpd_lightning.metrics.registry import REFERENCES, blocks, image_metrics, motion_metrics

_CAPTIONS = {
    "curves": "The same figures by predicted step, beside those of the references.",
    "contact_sheet": "Held-out clips by camera: truth, prediction and error (black 0, pale yellow 0.5 or more of 1).",
}
_REFERENCE_TITLES = {"copy_last": "last frame repeated", "train_mean": "mean training image"}


def write_web_page(folder: Path, metrics: Mapping[str, Any]) -> Path:
    """Write the page of an evaluation beside its files in ``folder``.

    Pictures and films are shown by their relative names, so the folder can be moved or sent as it is.
    """
    protocol = metrics["protocol"]
    names = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*.webm"))
    pictures = sorted((path.relative_to(folder).as_posix() for path in folder.rglob("*.png")), key=_curves_first)
    parts = [
        paragraph(
            f"{protocol['num_steps']} steps predicted from two frames, of {protocol['num_clips']} clips of "
            f"{protocol['num_trajectories']} {protocol['split']} recordings with {protocol['num_views']} cameras. "
            f"{metrics.get('checkpoint', '')}"
        )
    ]
    parts += [paragraph(line, is_warning=True) for line in seen_lines(metrics)]
    if not metrics["finite"]:
        parts.append(paragraph("NOT FINITE: some predictions are NaN or infinite.", is_warning=True))
    if names:
        captions = {name: f"{_film_title(name)}: truth, prediction, error; slowed." for name in names}
        parts += ["<h2>Films</h2>", films(captions)]
    parts += ["<h2>Figures</h2>", *_image_table(metrics), *_motion_table(metrics)]
    parts += [f"<p>{escape(line)}</p>" for line in _particle_lines(metrics)]
    if pictures:
        parts.append("<h2>Curves and pictures</h2>")
        parts += [picture(name, _CAPTIONS.get(Path(name).stem, name)) for name in pictures]
    parts += [
        "<h2>More</h2>",
        folded("All figures by predicted step", [_step_table(metrics)]),
        folded("As vpd-eval prints them", [f"<pre>{escape(chr(10).join(summary_lines(metrics)))}</pre>"]),
        '<p><a href="metrics.json">metrics.json</a> has all of it.</p>',
    ]
    path = folder / "index.html"
    with AtomicPath(path) as partial:
        title = f"{metrics.get('model', 'model')}, {protocol['split']}"
        partial.write_text(html_page(title, parts), encoding="utf-8")
    return path


def _curves_first(name: str) -> tuple[bool, str]:
    return Path(name).stem != "curves", name


def _film_title(name: str) -> str:
    return Path(name).stem.replace("_", " ")


def _image_table(metrics: Mapping[str, Any]) -> list[str]:
    """Scores of pictures: the model's, those of the references, and what is gained over the better one."""
    rows = []
    for info in image_metrics():
        if not info.in_summary or info.name not in metrics or metrics[info.name]["mean"] is None:
            continue
        model = metrics[info.name]["mean"]
        references = [metrics["references"][source][info.name]["mean"] for source in REFERENCES]
        better = {"higher": " ↑", "lower": " ↓"}.get(info.better, "")
        cells = [info.shown(value) for value in (model, *references)]
        rows.append((info.label + better, [*cells, gain(info, model, references).strip()]))
    columns = ["pictures", "model", *(_REFERENCE_TITLES[source] for source in REFERENCES), "gain over the better one"]
    return [table(columns, rows, marked=[0])] if rows else []


def _motion_table(metrics: Mapping[str, Any]) -> list[str]:
    """Errors of bodies after some steps; references stand below, indented."""
    if not metrics["motion"]:
        return []
    rows = [row for info in motion_metrics() if info.in_summary for row in motion_rows(info, metrics["motion"])]
    steps = horizons(metrics["protocol"]["num_steps"])
    shown = [
        (name.replace("  ", "\N{NO-BREAK SPACE}" * 4), [cells[step - 1] for step in steps]) for name, cells in rows
    ]
    return ["<h3>Bodies, after so many steps</h3>", table(["", *(str(step) for step in steps)], shown)] if rows else []


def _particle_lines(metrics: Mapping[str, Any]) -> list[str]:
    known = [info for info in blocks() if info.in_summary and metrics[info.name]]
    return [f"{info.spoken(metrics[info.name]['mean'])}: {info.description}." for info in known]


def _step_table(metrics: Mapping[str, Any]) -> str:
    steps = step_table(metrics)
    chosen = [steps["step"].index(step) for step in horizons(metrics["protocol"]["num_steps"]) if step in steps["step"]]
    rows = [(name, [_number(values[place]) for place in chosen]) for name, values in steps.items() if name != "step"]
    return table(["step", *(str(steps["step"][place]) for place in chosen)], rows)


def _number(value: float | int | None) -> str:
    if value is None:
        return "-"
    return str(value) if isinstance(value, int) else f"{value:.4g}"
