"""``index.html``: one evaluation on one page that opens from disk, without a server and without a network."""

from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

from vpd_lightning.evaluation.report import step_table
from vpd_lightning.evaluation.summary import horizons, summary_lines
from vpd_lightning.files import AtomicPath

_STYLE = """
:root { color-scheme: light dark; }
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 72rem; padding: 0 1rem; }
pre, table { font-size: 13px; overflow-x: auto; }
table { border-collapse: collapse; } td, th { padding: .2rem .7rem; text-align: right; border-bottom: 1px solid #8885; }
th:first-child, td:first-child { text-align: left; }
img, video { max-width: 100%; image-rendering: pixelated; }
"""


def write_web_page(folder: Path, metrics: Mapping[str, Any]) -> Path:
    """Write the page of an evaluation beside its files: figures, the scores by step, pictures and films in ``folder``.

    Pictures and films are shown by their relative names, so the folder can be moved or sent as it is.
    """
    pictures = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*.png"))
    films = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*.webm"))
    title = f"{metrics.get('model', 'model')}, {metrics['protocol']['split']}"
    parts = [
        "<!doctype html>",
        '<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">',
        f"<title>{escape(title)}</title><style>{_STYLE}</style></head><body>",
        f"<h1>{escape(title)}</h1>",
        f"<p>{escape(str(metrics.get('checkpoint', '')))}</p>",
        f"<pre>{escape(chr(10).join(summary_lines(metrics)))}</pre>",
        "<h2>By predicted step</h2>",
        *_table(metrics),
        *(
            f'<h2>{escape(name)}</h2><a href="{escape(name)}"><img src="{escape(name)}" alt=""></a>'
            for name in pictures
        ),
        *(f'<h2>{escape(name)}</h2><video src="{escape(name)}" controls loop muted></video>' for name in films),
        '<p><a href="metrics.json">metrics.json</a></p></body></html>',
    ]
    path = folder / "index.html"
    with AtomicPath(path) as partial:
        partial.write_text("\n".join(parts) + "\n", encoding="utf-8")
    return path


def _table(metrics: Mapping[str, Any]) -> list[str]:
    table = step_table(metrics)
    chosen = [table["step"].index(step) for step in horizons(metrics["protocol"]["num_steps"]) if step in table["step"]]
    lines = ["<table>"]
    for name, values in table.items():
        cell = "th" if name == "step" else "td"
        row = "".join(f"<{cell}>{_number(values[place])}</{cell}>" for place in chosen)
        lines.append(f"<tr><th>{escape(name)}</th>{row}</tr>")
    return [*lines, "</table>"]


def _number(value: float | int | None) -> str:
    if value is None:
        return "-"
    return str(value) if isinstance(value, int) else f"{value:.4g}"
