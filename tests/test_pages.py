"""Files, modules, functions, options and sizes that the pages name exist."""

import ast
import importlib.util
import re
from functools import cache
from pathlib import Path

import pytest
import torch

from vpd_lightning.config import build_simulator, compose

ROOT = Path(__file__).resolve().parents[1]
PAGES = {name: (ROOT / "docs" / f"{name}.md").read_text() for name in ("paper_map", "systems")}
HOMES = (ROOT / "src" / "vpd_lightning", ROOT / "src" / "vpd_lightning" / "baselines", ROOT)
# `encoder/unet.py`: `UNetEncoder.forward`, `other`
CODE = re.compile(r"`([\w/]+\.py)`(?:: ((?:`[A-Za-z_][\w.]*`(?:, | and )?)+))?")
OPTIONS = {group: sorted(path.stem for path in (ROOT / "conf" / group).glob("*.yaml")) for group in ("model", "sweep")}


def find(path: str) -> Path | None:
    return next((home / path for home in HOMES if (home / path).is_file()), None)


@cache
def names_in(path: Path) -> set[str]:
    """Classes, functions and assigned names of a file, with ``Class.member`` too."""
    names: set[str] = set()
    for node in ast.parse(path.read_text()).body:
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        names |= {target.id for target in targets if isinstance(target, ast.Name)}
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
        if isinstance(node, ast.ClassDef):
            names |= {f"{node.name}.{inner.name}" for inner in node.body if isinstance(inner, ast.FunctionDef)}
    return names


@pytest.mark.parametrize("page", PAGES)
def test_code_that_a_page_names_is_there(page: str) -> None:
    mentions = CODE.findall(PAGES[page])
    assert len(mentions) > 15
    wrong = []
    for file, words in mentions:
        path = find(file)
        if path is None:
            wrong.append(file)
            continue
        named = [word for word in re.findall(r"`([^`]+)`", words) if word[:1].isupper() or "_" in word]
        wrong += [f"{file}: {word}" for word in named if word not in names_in(path)]
    assert not wrong


@pytest.mark.parametrize("page", PAGES)
def test_configuration_that_a_page_names_is_there(page: str) -> None:
    named = re.findall(r"`((?:conf|data_gen|docs|benchmarks)/[\w/*.-]+\.(?:yaml|py|md))`", PAGES[page])
    assert named or page == "systems"  # which names folders of options
    assert not [path for path in named if not list(ROOT.glob(path))]


@pytest.mark.parametrize("group", OPTIONS)
def test_every_system_and_sweep_is_described(group: str) -> None:
    described = set(re.findall(rf"{group}=([\w]+)", PAGES["systems"])) | set(
        re.findall(r"^\| \[?`(\w+)`", PAGES["systems"], re.MULTILINE)
    )
    assert set(OPTIONS[group]) <= described
    assert set(re.findall(rf"`?{group}=([a-z_]\w*)", PAGES["systems"])) <= set(OPTIONS[group])


def test_parameter_counts_are_those_of_the_models() -> None:
    rows = re.findall(r"^\| \[`(\w+)`\].*\| ([\d,]+) \|$", PAGES["systems"], re.MULTILINE)
    assert {name for name, _ in rows} == set(OPTIONS["model"])
    for name, printed in rows:
        config = compose("train", ["experiment=mujoco_block", f"model={name}"])
        with torch.device("meta"):  # sizes without numbers
            system = build_simulator(config)
        assert f"{sum(parameter.numel() for parameter in system.parameters()):,}" == printed, name


@pytest.mark.parametrize("page", ["README.md", *sorted(path.name for path in (ROOT / "docs").glob("*.md"))])
def test_modules_that_a_page_tells_to_run_are_there(page: str) -> None:
    text = (ROOT / page if page == "README.md" else ROOT / "docs" / page).read_text()
    modules = {name for name in re.findall(r"python -m ([\w.]+)", text) if name not in ("pytest", "venv")}
    assert not [name for name in modules if importlib.util.find_spec(name) is None]


def test_links_of_the_readme_lead_to_files() -> None:
    links = re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", (ROOT / "README.md").read_text())
    assert len(links) > 30
    assert not [link for link in links if "://" not in link and not (ROOT / link).exists()]
