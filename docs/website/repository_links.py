"""MkDocs hook: links that leave ``docs/`` work on the repository's page, and on the site, too.

A picture is copied into the site, below ``repository/``. Any other file or folder becomes a link to the repository
where ``repo_url`` is set in ``mkdocs.yml``, and the plain path where it is not.
"""

import os
import re
from pathlib import Path
from urllib.parse import urlsplit

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

PICTURES = {".png", ".jpg", ".jpeg", ".svg", ".gif", ".webm"}
# Code is left alone: a fenced block, or what stands between backquotes.
LINK = re.compile(
    r"(?P<code>^ *```.*?^ *```|`[^`\n]*`)|(?P<mark>!?)\[(?P<text>[^\]]*)\]\((?P<to>[^)\s]+)\)", re.M | re.S
)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pictures outside ``docs/`` that a page shows."""
    for page in list(files.documentation_pages()):
        for found in LINK.finditer(page.content_string):
            path = found["to"] and leaving(found["to"], page.src_uri, config)
            if path and shown_on_the_site(path) and not files.get_file_from_path(place(path)):
                picture = File.generated(config, place(path), abs_src_path=str(root(config) / path))
                files.append(picture)
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Point links that leave ``docs/`` to where they lead on the site."""

    def point(found: re.Match[str]) -> str:
        path = found["to"] and leaving(found["to"], page.file.src_uri, config)
        if not path:
            return found[0]
        if shown_on_the_site(path):
            way = os.path.relpath(place(path), os.path.dirname(page.file.src_uri) or ".")
            return f"{found['mark']}[{found['text']}]({Path(way).as_posix()})"
        if config.repo_url:
            return f"[{found['text']}]({config.repo_url.rstrip('/')}/blob/HEAD/{path})"
        return f"`{path}`" if found["text"].strip("`") in (path, Path(path).name) else f"{found['text']} (`{path}`)"

    return LINK.sub(point, markdown)


def leaving(link: str, page: str, config: MkDocsConfig) -> str | None:
    """Return the path from the repository's root that a link leads to, or None where it stays below ``docs/``.

    Raises:
        FileNotFoundError: there is no such file.
    """
    parts = urlsplit(link)
    if parts.scheme or parts.netloc or not parts.path.startswith("../"):
        return None
    docs = Path(config.docs_dir)
    target = Path(os.path.normpath(docs / Path(page).parent / parts.path))
    if target.is_relative_to(docs):
        return None
    if not target.exists():
        raise FileNotFoundError(f"{page} links to {link}, which is not there")
    return target.relative_to(root(config)).as_posix()


def root(config: MkDocsConfig) -> Path:
    """Return the folder of the repository."""
    return Path(config.config_file_path).parent


def place(path: str) -> str:
    """Return where a picture of the repository lies on the site."""
    return f"repository/{path}"


def shown_on_the_site(path: str) -> bool:
    """Tell whether a file is copied."""
    return Path(path).suffix in PICTURES
