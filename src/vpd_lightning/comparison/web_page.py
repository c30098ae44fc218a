"""``index.html``: the report as a page, which begins with its films."""

from collections.abc import Sequence
from pathlib import Path

import markdown

from vpd_lightning.media.html import films, html_page


def web_page(title: str, report: str, paths: Sequence[Path]) -> str:
    """Return the page of a report (Markdown, whose first line is its heading); its films lie in the page's folder."""
    _, _, body = report.partition("\n")
    converter = markdown.Markdown(extensions=["tables", "sane_lists"])
    # Names of folders and systems come from outside: HTML in them is text.
    converter.preprocessors.deregister("html_block")
    converter.inlinePatterns.deregister("html")
    captions = {
        path.name: f"{path.stem.replace('_', ' ')}: the same rollout by every system, beside the truth."
        for path in paths
    }
    shown = ["<h2>Films</h2>", films(captions)] if captions else []
    return html_page(title, [*shown, converter.convert(body)])
