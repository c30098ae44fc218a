"""Web pages that open from disk, without a server and without a network: films first, then figures."""

from collections.abc import Mapping, Sequence
from html import escape

_STYLE = """
:root { color-scheme: dark; --line: #ffffff22; }
body { font: 15px/1.5 system-ui, sans-serif; margin: 0 auto; max-width: 76rem; padding: 1.5rem 1rem 4rem;
  background: #181818; color: #ddd; }
h1, h2, h3 { color: #fff; line-height: 1.25; } h2 { margin-top: 2.5rem; } a { color: #6cb2ff; }
pre { font-size: 13px; overflow-x: auto; } summary { cursor: pointer; color: #6cb2ff; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: 14px; }
td, th { padding: .25rem .8rem; text-align: right; border-bottom: 1px solid var(--line); font-weight: normal; }
thead th, th[scope=col] { color: #999; } th:first-child, td:first-child { text-align: left; }
td.model { color: #fff; font-weight: 600; }
.films { display: grid; grid-template-columns: repeat(auto-fit, minmax(30rem, 1fr)); gap: 1rem; }
figure { margin: 0 0 1.5rem; } figcaption { color: #999; font-size: 13px; }
img, video { max-width: 100%; border-radius: 4px; } video { width: 100%; image-rendering: pixelated; }
.warning { border-left: 4px solid #e8590c; padding: .3rem 1rem; background: #ffffff0d; }
"""


def html_page(title: str, parts: Sequence[str]) -> str:
    """Return a whole page; ``title`` is its heading, ``parts`` are HTML."""
    head = (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{_STYLE}</style></head><body>"
    )
    return "\n".join([head, f"<h1>{escape(title)}</h1>", *parts, "</body></html>"]) + "\n"


def paragraph(text: str, is_warning: bool = False) -> str:
    """Return a paragraph of plain text."""
    marked = ' class="warning"' if is_warning else ""
    return f"<p{marked}>{escape(text)}</p>"


def films(captions: Mapping[str, str]) -> str:
    """Return films that play by themselves, round and round: captions by names that are relative to the page."""
    return "\n".join(['<div class="films">', *(_film(name, caption) for name, caption in captions.items()), "</div>"])


def _film(name: str, caption: str) -> str:
    return (
        f'<figure><video src="{escape(name)}" autoplay loop muted playsinline controls></video>'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )


def picture(name: str, caption: str) -> str:
    """Return a picture that a click enlarges; ``name`` is relative to the page."""
    return (
        f'<figure><a href="{escape(name)}"><img src="{escape(name)}" alt="{escape(caption)}"></a>'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )


def table(columns: Sequence[str], rows: Sequence[tuple[str, Sequence[str]]], marked: Sequence[int] = ()) -> str:
    """Return a table: a name and cells a row; ``marked`` columns of cells (from 0) are those of the model."""
    head = "".join(f'<th scope="col">{escape(column)}</th>' for column in columns)
    lines = [f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>']
    for name, cells in rows:
        classes = [' class="model"' if place in marked else "" for place in range(len(cells))]
        inner = "".join(f"<td{words}>{escape(cell)}</td>" for words, cell in zip(classes, cells, strict=True))
        lines.append(f'<tr><th scope="row">{escape(name)}</th>{inner}</tr>')
    return "\n".join([*lines, "</tbody></table></div>"])


def folded(title: str, parts: Sequence[str]) -> str:
    """Return what a click on its title unfolds."""
    return "\n".join([f"<details><summary>{escape(title)}</summary>", *parts, "</details>"])
