"""``index.html``: the report as a page, which begins with its films."""

from collections.abc import Sequence
from pathlib import Path

import markdown

from vpd_lightning.media.html import film, html_page


def web_page(title: str, report: str, films: Sequence[Path]) -> str:
    """Return the page of a report (Markdown, whose first line is its heading); films lie in the page's folder."""
    _, _, body = report.partition("\n")
    converter = markdown.Markdown(extensions=["tables", "sane_lists"])
    # Names of folders and systems come from outside: HTML in them is text.
    converter.preprocessors.deregister("html_block")
    converter.inlinePatterns.deregister("html")
    text = converter.convert(body)
    words = "the same rollout by every system, beside the truth"
    shown = [film(path.name, f"{path.stem.replace('_', ' ')}: {words}.") for path in films]
    return html_page(title, [*(["<h2>Films</h2>"] if shown else []), *shown, text])
