"""The wheel works by itself: built, installed away from the repository, run from another folder."""

import ast
import os
import shutil
import subprocess
import sys
import sysconfig
import tomllib
import venv
import zipfile
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[1]
COMMANDS = ("vpd-data", "vpd-train", "vpd-eval", "vpd-render", "vpd-report", "vpd-export", "vpd-bench", "vpd-info")


def run(*arguments: str | Path, cwd: Path) -> subprocess.CompletedProcess:
    """Run a command that must not see the repository."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("PYTHON", "VIRTUAL_ENV"))}
    return subprocess.run([str(a) for a in arguments], cwd=cwd, env=environment, capture_output=True, text=True)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    source = tmp_path_factory.mktemp("source")
    for name in ("src", "data_gen", "benchmarks", "conf"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)

    result = run(
        sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", source / "dist", source, cwd=source
    )

    assert result.returncode == 0, result.stdout + result.stderr
    [built] = (source / "dist").glob("*.whl")
    return built


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The ``bin`` folder of a fresh environment with our wheel and, borrowed from this one, its dependencies."""
    root = tmp_path_factory.mktemp("fresh") / "venv"
    venv.create(root, with_pip=False)
    [site_packages] = root.glob("lib/python*/site-packages")
    # Paths after our own; .pth files in the borrowed folder (this repository's editable install) are not read.
    (site_packages / "borrowed.pth").write_text(sysconfig.get_paths()["purelib"] + "\n")
    result = run(
        sys.executable, "-m", "pip", "--python", root / "bin" / "python", "install", "--no-deps", "--no-index",
        "--ignore-installed", "--disable-pip-version-check", wheel, cwd=root,
    )  # fmt: skip
    assert result.returncode == 0, result.stdout + result.stderr
    return root / "bin"


def test_everything_imported_is_required():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    optional = [line for name in ("cluster", "ros", "lerobot", "viewer", "planning", "lpips") for line in extras[name]]
    lines = [*project["dependencies"], *optional]
    required = {Requirement(line).name for line in lines}
    imported = set()
    files = {path for folder in ("src", "data_gen", "benchmarks") for path in (ROOT / folder).rglob("*.py")}
    for path in files - set((ROOT / "data_gen" / "blender").glob("job*.py")):  # these run in Blender's own environment
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                imported |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                imported.add(node.module.partition(".")[0])
    # The contract tests in vpd_lightning.testing run under pytest; PyTorch's builds for GPUs bring triton themselves.
    # Playwright drives the browser that one benchmark measures.
    own = {"vpd_lightning", "data_gen", "benchmarks", "pytest", "triton", "playwright"}
    packages = {"torch_cluster": ["torch-cluster"], "torchvision": ["torchvision"], **packages_distributions()}
    missing = {
        name
        for name in imported - own - sys.stdlib_module_names
        if not required & {found.replace("_", "-").lower() for found in packages.get(name, [])}
    }

    assert not missing


@pytest.mark.slow
@pytest.mark.package
def test_wheel_holds_code_configuration_and_licence_but_no_tests(wheel: Path):
    names = zipfile.ZipFile(wheel).namelist()

    assert "vpd_lightning/simulator.py" in names
    assert "vpd_lightning/conf/train.yaml" in names
    assert "vpd_lightning/conf/experiment/mujoco_block.yaml" in names
    assert "data_gen/__init__.py" in names
    assert "benchmarks/suites/scaling.py" in names
    assert any(name.endswith("licenses/LICENSE") for name in names)
    assert not [name for name in names if name.startswith(("tests", "benchmarks/results/", "docs"))]


@pytest.mark.slow
@pytest.mark.package
def test_installed_package_is_the_wheels(installed: Path, tmp_path: Path):
    result = run(installed / "python", "-c", "import vpd_lightning; print(vpd_lightning.__file__)", cwd=tmp_path)

    assert result.stdout.startswith(str(installed.parent)), result.stdout + result.stderr


@pytest.mark.slow
@pytest.mark.package
@pytest.mark.parametrize("command", COMMANDS)
def test_installed_command_shows_its_help_from_another_folder(installed: Path, command: str, tmp_path: Path):
    result = run(installed / command, "--help", cwd=tmp_path)

    assert result.returncode == 0, result.stderr
    assert command in result.stdout


@pytest.mark.slow
@pytest.mark.package
@pytest.mark.parametrize("experiment", ["tiny", "mujoco_block"])
def test_installed_training_command_composes_an_experiment(installed: Path, experiment: str, tmp_path: Path):
    result = run(installed / "vpd-train", f"experiment={experiment}", "--cfg", "job", cwd=tmp_path)

    assert result.returncode == 0, result.stderr
    assert "_target_: vpd_lightning." in result.stdout


@pytest.mark.slow
@pytest.mark.package
def test_installed_generator_finds_its_presets(installed: Path, tmp_path: Path):
    result = run(
        installed / "vpd-data", "generate", "scene=mujoco_block", "preset=tiny", "out=data", "seed=0", cwd=tmp_path
    )

    assert result.returncode == 0, result.stdout + result.stderr
    assert (tmp_path / "data" / "dataset.json").is_file()
