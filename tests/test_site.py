"""``docs/`` builds as a site without a warning, every page is in the menu, and nothing comes from another host."""

import os
import re
import subprocess
import sys
import tomllib
from collections import Counter
from html.parser import HTMLParser
from importlib import import_module
from pathlib import Path
from runpy import run_path
from urllib.parse import unquote, urlsplit

import pytest
import yaml
from markdown_it import MarkdownIt
from mkdocs.config import load_config
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from vpd_lightning.config import compose, config_folder

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
CONCEPTS = (DOCS / "concepts.md").read_text()
SCRIPTS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
# The sections of docs/commands.md: "## vpd-train" and what stands below it.
SECTIONS = dict(re.findall(r"^## (vpd-\w+)\n(.*?)(?=^## |\Z)", (DOCS / "commands.md").read_text(), re.M | re.S))
# What a browser fetches by itself, without a click.
FETCHED = {
    "script": ("src",), "img": ("src", "srcset"), "source": ("src", "srcset"), "video": ("src", "poster"),
    "audio": ("src",), "iframe": ("src",), "embed": ("src",), "object": ("data",), "link": ("href",), "use": ("href",),
}  # fmt: skip


class Resources(HTMLParser):
    """Collects what a page fetches by itself."""

    def __init__(self, page: Path):
        super().__init__()
        self.found: list[str] = []
        self.feed(page.read_text())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found += [value for name, value in attrs if name in FETCHED.get(tag, ()) and value]
        self.found += re.findall(r"url\(['\"]?([^'\")]+)", dict(attrs).get("style") or "")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1", "PYTHONDONTWRITEBYTECODE": "1"}
    words = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", folder]
    result = subprocess.run(words, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert result.returncode == 0 and not result.stdout + result.stderr, result.stdout + result.stderr
    return folder


def menu(entry: object) -> list[str]:
    if isinstance(entry, str):
        return [entry]
    return [name for inner in (entry.values() if isinstance(entry, dict) else entry) for name in menu(inner)]


def test_every_page_is_in_the_menu_once() -> None:
    text = (ROOT / "mkdocs.yml").read_text()
    listed = menu(yaml.safe_load(text[text.index("\nnav:") :])["nav"])

    assert sorted(listed) == sorted(page.name for page in DOCS.glob("*.md"))


@pytest.mark.slow
@pytest.mark.site
def test_site_builds_without_a_warning(site: Path) -> None:
    assert {page.with_suffix(".html").name for page in DOCS.glob("*.md")} <= {page.name for page in site.glob("*.html")}
    assert (site / "search" / "search_index.json").stat().st_size > 100_000
    assert not list(site.rglob("*.py"))


@pytest.mark.slow
@pytest.mark.site
def test_no_page_loads_anything_from_another_host(site: Path) -> None:
    pages = list(site.rglob("*.html"))
    outside = {link for page in pages for link in Resources(page).found if urlsplit(link).scheme or link[:2] == "//"}
    styles = {path: re.findall(r"url\(['\"]?(?:https?:)?//|@import", path.read_text()) for path in site.rglob("*.css")}

    assert len(pages) > 20
    assert not {link for link in outside if not link.startswith("data:")}
    assert not [path for path, found in styles.items() if found]
    # The theme's script fetches Mermaid from a CDN where a page holds a diagram of it.
    assert not [page for page in pages if 'class="mermaid"' in page.read_text()]


@pytest.mark.slow
@pytest.mark.site
def test_everything_that_a_page_shows_is_there(site: Path) -> None:
    missing = []
    pictures = set()
    for page in site.rglob("*.html"):
        base = site if page.name == "404.html" else page.parent  # which can be answered anywhere, from the root
        for link in Resources(page).found:
            path = base / unquote(urlsplit(link).path).removeprefix("/" if base == site else "")
            missing += [] if link.startswith("data:") or path.exists() else [f"{page.name}: {link}"]
            pictures.add(path.resolve())

    assert not missing
    shown = {path.name for path in pictures}
    assert {"data_flow.svg", "accuracy_cpu.png", "released_demo.png", "strips.png"} <= shown


@pytest.mark.slow
@pytest.mark.site
def test_links_that_leave_the_pages_are_no_links_on_the_site(site: Path) -> None:
    guide = (site / "adding_a_component.html").read_text()

    assert "../examples/" not in guide
    assert "<code>examples/my_lab/README.md</code>" in guide


def test_they_are_links_where_the_address_of_the_repository_is_known() -> None:
    config = load_config(str(ROOT / "mkdocs.yml"), repo_url="https://example.org/vpd/")
    hook = run_path(str(DOCS / "website" / "repository_links.py"))
    files = Files(
        [File(name, config.docs_dir, config.site_dir, use_directory_urls=False) for name in ("index.md", "a/b.md")]
    )
    plot = "benchmarks/results/scaling_cpu.png"
    text = f"[guide](../../README.md) `[no](../../link.md)` ![plot](../../{plot}) [b](../index.md)"

    pointed = hook["on_page_markdown"](text, Page(None, files.src_uris["a/b.md"], config), config, files)

    assert pointed == (
        "[guide](https://example.org/vpd/blob/HEAD/README.md) `[no](../../link.md)` "
        f"![plot](../repository/{plot}) [b](../index.md)"
    )


def test_link_to_a_file_that_is_not_there_is_refused() -> None:
    config = load_config(str(ROOT / "mkdocs.yml"))
    hook = run_path(str(DOCS / "website" / "repository_links.py"))

    with pytest.raises(FileNotFoundError, match=r"page.md links to ../no_such_file.md"):
        hook["leaving"]("../no_such_file.md", "page.md", config)


@pytest.mark.slow
@pytest.mark.site
@pytest.mark.parametrize("page", sorted(DOCS.rglob("*.md")), ids=lambda page: page.relative_to(DOCS).as_posix())
def test_page_has_the_same_parts_on_the_site_as_in_the_repository(site: Path, page: Path) -> None:
    """The site's Markdown is stricter: lists need a blank line before them, and four blanks inside them."""
    text = (site / page.relative_to(DOCS).with_suffix(".html")).read_text()
    article = text[text.index("<article") : text.index("</article>")]

    assert parts(article) == parts(MarkdownIt("commonmark").enable("table").render(page.read_text()))


def parts(html: str) -> Counter[str]:
    return Counter(re.findall(r"<(ul|ol|li|table|tr|td|th|img|pre|h1|h2|h3|h4|strong|em)[ >]", html))


def test_every_command_has_a_section() -> None:
    assert sorted(SECTIONS) == sorted(SCRIPTS)


@pytest.mark.parametrize("command", SCRIPTS)
def test_examples_of_a_command_are_those_of_its_help(command: str) -> None:
    printed = re.search(r"^```\n(.*?)^```", SECTIONS[command], re.M | re.S)
    found = re.search(r"^Examples:?\n((?: +\S.*\n)+)", help_of(command), re.M)

    assert printed and found
    assert printed[1].splitlines() == [line.strip() for line in found[1].splitlines()]


@pytest.mark.parametrize("command", [name for name in SCRIPTS if name != "vpd-info"])  # which has no settings
def test_settings_that_a_section_lists_are_there(command: str) -> None:
    keys = re.findall(r"^\| `([\w.]+)=", SECTIONS[command], re.M)
    assert keys
    root = command.removeprefix("vpd-")
    if not (config_folder() / f"{root}.yaml").is_file():
        printed = help_of(command)
        assert not [key for key in keys if not re.search(rf"\b{re.escape(key)}\b", printed)]
        return
    needed = {"train": ["experiment=mujoco_block"], "bench": ["suite=all"], "export": ["ckpt=x", "out=y"]}
    config = compose(root, needed.get(root, ["ckpt=x"]))
    groups = {path.name for path in config_folder().iterdir() if path.is_dir()}
    assert not [key for key in keys if key not in groups and not is_set(config, key.split("."))]


def is_set(config: object, path: list[str]) -> bool:
    return not path or (isinstance(config, dict) and path[0] in config and is_set(config[path[0]], path[1:]))


def help_of(command: str) -> str:
    """Return what ``--help`` prints, without starting Hydra."""
    template = config_folder() / "hydra" / "help" / f"{command.removeprefix('vpd-')}.yaml"
    if template.is_file():
        return yaml.safe_load(template.read_text())["template"]
    return import_module(SCRIPTS[command].partition(":")[0]).HELP


def test_code_that_the_concepts_name_is_there() -> None:
    files = re.findall(r"`([\w/]+\.py)`", CONCEPTS) + re.findall(
        r">([\w/]+\.py)<", (DOCS / "images" / "data_flow.svg").read_text()
    )

    assert len(files) > 10
    homes = (ROOT, ROOT / "src" / "vpd_lightning")
    assert not [name for name in files if not any((home / name).is_file() for home in homes)]
    for name, word in re.findall(r"`([\w/]+\.py)`: `(\w+)`", CONCEPTS):
        assert f"class {word}" in (ROOT / "src" / "vpd_lightning" / name).read_text(), word
