"""``examples/my_lab`` is what docs/adding_a_component.md prints, and works once pip has installed it somewhere."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from data_gen.generate import generate

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "examples" / "my_lab"
GUIDE = ROOT / "docs" / "adding_a_component.md"
# A file of the guide: its path in backquotes on a line of its own, then its content.
LISTED_FILE = re.compile(r"^`([\w./]+)`\n\n```\w+\n(.*?)^```", re.MULTILINE | re.DOTALL)
NOT_LISTED = {"README.md"}  # it sends its reader to the guide


def test_guide_prints_the_files_of_the_package() -> None:
    files = {
        path.relative_to(PACKAGE).as_posix(): path.read_text()
        for path in PACKAGE.rglob("*")
        if path.is_file() and path.suffix != ".pyc"
    }
    printed = dict(LISTED_FILE.findall(GUIDE.read_text()))

    assert printed == {name: text for name, text in files.items() if name not in NOT_LISTED}
    drawn = re.search(r"^examples/my_lab/\n((?:  .*\n)+)", GUIDE.read_text(), re.MULTILINE)
    assert drawn and drawn[1].split() == list(printed)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with nothing but the package, put there by pip."""
    folder = tmp_path_factory.mktemp("installed") / "site"
    python(
        "-m", "pip", "install", "--no-deps", "--no-index", "--no-build-isolation", "--disable-pip-version-check",
        "--target", folder, PACKAGE,
    )  # fmt: skip
    return folder


@pytest.fixture(scope="module")
def run(site: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder of two training steps with the package's dynamics."""
    folder = tmp_path_factory.mktemp("drift")
    small = {"num_frames": 10, "camera.num_views": 3, "camera.height": 32, "camera.width": 32}
    data = generate("mujoco_block", "tiny", folder / "data", seed=0, workers=1, overrides=small)
    python(
        "-m", "vpd_lightning.commands.train", "experiment=tiny", "dynamics=drift", "dynamics.hidden_dim=16",
        f"data.folder={data}", f"run.folder={folder / 'run'}", "trainer.max_steps=2", "trainer.val_check_interval=2",
        "callbacks.keep_checkpoints.every_n_steps=1", "callbacks.draw_rollouts=null", "logger=csv",
        "scene.input_views=[0,1,2]", "num_threads=1", site=site, cwd=folder,
    )  # fmt: skip
    return folder / "run"


@pytest.mark.slow
@pytest.mark.package
def test_package_is_chosen_without_a_change_of_ours(run: Path) -> None:
    section = yaml.safe_load((run / "config.yaml").read_text())["dynamics"]

    assert section["_target_"] == "my_lab.drift.DriftDynamics"
    assert section["hidden_dim"] == 16 and section["match_scale"] == 0.05  # from the line above, and from drift.yaml


@pytest.mark.slow
@pytest.mark.package
def test_its_checkpoint_loads_and_its_contract_is_kept(site: Path, run: Path, tmp_path: Path) -> None:
    code = (
        f"import sys, pytest, vpd_lightning; dynamics = vpd_lightning.load({str(run)!r}).dynamics; "
        "print(type(dynamics).__module__, sys.modules['my_lab'].__file__, dynamics.network[0].out_features); "
        f"sys.exit(pytest.main(['-q', '-p', 'no:cacheprovider', '-c', {os.devnull!r}, {str(PACKAGE / 'tests')!r}]))"
    )

    printed = python("-c", code, site=site, cwd=tmp_path)

    assert printed.split()[:3] == ["my_lab.drift", str(site / "my_lab" / "__init__.py"), "16"]
    passed = re.search(r"(\d+) passed", printed)
    assert passed and int(passed[1]) >= 10, printed


def python(*words: str | Path, site: Path | None = None, cwd: Path | None = None) -> str:
    """Run this Python on the checkout and, where given, what is installed in ``site``; return what it printed."""
    places = [*([site] if site else []), ROOT / "src", ROOT]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, places)), "PYTHONDONTWRITEBYTECODE": "1"}
    result = subprocess.run(
        [sys.executable, *map(str, words)], cwd=cwd, env=environment, capture_output=True, text=True
    )
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout
