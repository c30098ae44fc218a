"""The rules of the house that a machine can check."""

import ast
import json
import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
OUR_CODE = sorted(
    path for folder in ("src", "data_gen", "benchmarks", "docs") for path in ROOT.glob(f"{folder}/**/*.py")
)
OUR_TESTS = sorted(ROOT.glob("tests/**/*.py"))
STAGES = ("encoder", "dynamics", "renderer", "losses")
ENVIRONMENT = {**os.environ, "PYTHONPATH": f"{ROOT / 'src'}{os.pathsep}{ROOT}"}
DRAWERS = {"utils", "util", "misc", "helpers", "helper", "common", "tools", "lib"}


def shown(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def imported_modules(path: Path) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names.add(node.module)
    return names


def test_imports_point_one_way():
    linter = Path(sys.executable).with_name("lint-imports")

    result = subprocess.run([linter, "--no-cache"], cwd=ROOT, env=ENVIRONMENT, capture_output=True, text=True)

    assert result.returncode == 0, result.stdout + result.stderr


def test_no_file_is_longer_than_400_lines():
    lengths = {shown(path): len(path.read_text().splitlines()) for path in [*OUR_CODE, *OUR_TESTS]}

    assert not {name: length for name, length in lengths.items() if length > 400}


def test_no_module_is_a_drawer():
    drawers = [shown(path) for path in [*OUR_CODE, *OUR_TESTS] if DRAWERS & set(path.with_suffix("").parts)]

    assert not drawers


def test_nothing_imports_the_second_copy_of_lightning():
    offenders = [
        shown(path)
        for path in [*OUR_CODE, *OUR_TESTS]
        if any(name.split(".")[0] == "pytorch_lightning" for name in imported_modules(path))
    ]

    assert not offenders


@pytest.mark.parametrize("stage", STAGES)
def test_one_file_holds_one_option_of_a_stage(stage: str):
    crowded = {}
    for path in (ROOT / "src/vpd_lightning" / stage).glob("*.py"):
        classes = [node for node in ast.parse(path.read_text()).body if isinstance(node, ast.ClassDef)]
        options = [c.name for c in classes if any(ast.unparse(base).startswith("Abstract") for base in c.bases)]
        if len(options) > 1:
            crowded[shown(path)] = options

    assert not crowded


def loaded_after(statement: str) -> set[str]:
    """Top-level modules in a fresh interpreter after ``statement``."""
    script = f"{statement}\nimport sys\nprint(*{{name.split('.')[0] for name in sys.modules}})"
    result = subprocess.run([sys.executable, "-c", script], env=ENVIRONMENT, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    return set(result.stdout.split())


def test_file_format_loads_neither_torch_nor_lightning():
    loaded = loaded_after("import vpd_lightning.data.schema")

    assert not loaded & {"torch", "lightning", "hydra", "omegaconf", "mujoco", "cv2"}


def test_simulator_loads_neither_lightning_nor_hydra():
    loaded = loaded_after("import vpd_lightning.simulator")

    assert not loaded & {"lightning", "hydra", "omegaconf", "mujoco", "h5py"}


def test_importing_the_package_loads_nothing_heavy():
    loaded = loaded_after("import vpd_lightning")

    assert not loaded & {"lightning", "hydra", "mujoco", "cv2", "h5py", "torch_geometric"}


# Three seconds of a slow core. Counted today: 0.9 million for vpd-train, 0.6 million and less for the others.
MOST_CALLS_OF_HELP = 2_000_000
HEAVY = {"torch", "lightning", "mujoco", "cv2", "h5py", "numpy", "numba", "scipy", "matplotlib", "viser"}
COUNTED = """
import cProfile, json, sys
sys.argv[0] = {command!r}
profile = cProfile.Profile(builtins=False)
profile.enable()
from {module} import {function}
try:
    code = {function}()
except SystemExit as end:
    code = end.code
profile.disable()
json.dump([sum(entry.callcount for entry in profile.getstats()), sorted(sys.modules)], open({path!r}, "w"))
sys.exit(code)
"""


@pytest.mark.parametrize("command", sorted(PROJECT["project"]["scripts"]))
def test_help_does_little_and_loads_nothing_heavy(command: str, tmp_path: Path):
    module, function = PROJECT["project"]["scripts"][command].split(":")
    (tmp_path / "here").mkdir()
    words = {"command": command, "module": module, "function": function, "path": str(tmp_path / "counted.json")}

    result = subprocess.run(
        [sys.executable, "-c", COUNTED.format(**words), "--help"],
        cwd=tmp_path / "here", env=ENVIRONMENT, capture_output=True, text=True,
    )  # fmt: skip

    assert result.returncode == 0, result.stderr
    assert command in result.stdout
    calls, loaded = json.loads((tmp_path / "counted.json").read_text())
    assert calls < MOST_CALLS_OF_HELP
    assert not HEAVY & set(loaded)
    assert not list((tmp_path / "here").iterdir()), "asking for help wrote files"
