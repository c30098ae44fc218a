"""The Python that README and docs print runs, on a few frames, with what a page takes for given."""

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pytest
import torch

import vpd_lightning as vpd
from data_gen.generate import generate
from tests.data.recordings import make_trajectory
from tests.documents.printed import PAGES, ROOT, blocks
from vpd_lightning.types import Cameras

pytestmark = pytest.mark.documents
BLOCKS = [(page.name, index, text) for page in PAGES for index, text in enumerate(blocks(page, "python"))]
# Words of a block that does not run, and why; it must compile.
NOT_RUN = {
    "class DriftDynamics": "a file of examples/my_lab; tests/integration/test_example_package.py installs and runs it",
    "config_folder = ": "as above",
    "class TestDrift": "as above",
    "class TestSampled": "a part of a test; tests/test_contract_faults.py runs its like",
    "vpd.Driven.from_arrays": "needs a model that takes actions; tests/test_actions.py does the same with a small one",
    "found = vpd.plan": "as above; tests/planning/test_plan.py",
    "renderer.pt2": "needs minutes of torch.export; tests/release/test_renderer_program.py runs it",
}


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What pages take for given: frames of the demo's cameras, a predicted rollout, recordings, a goal."""
    folder = tmp_path_factory.mktemp("python")
    few = {"splits.train": 0, "splits.validation": 0, "splits.test": 1, "num_frames": 6}
    generate("mujoco_block", "demo", folder / "block", 0, renderer="raycast", workers=1, overrides=few)
    with h5py.File(folder / "block" / "test" / "000000.h5") as file:
        rgb, depth = [torch.from_numpy(file[name][:2]) for name in ("rgb", "depth")]
        matrices = [torch.from_numpy(file[name][()]).float() for name in ("intrinsics", "cam_to_world")]
    cameras = Cameras(*matrices, *rgb.shape[2:4])
    simulator = vpd.load(ROOT / "released" / "mujoco_block_demo", device="cpu")
    scene = simulator.encode(rgb, depth, cameras)
    reached = iter([False, True])
    return {
        "rgb": rgb, "depth": depth, "cameras": cameras, "simulator": simulator, "scene": scene,
        "states": simulator.rollout(scene, num_steps=1), "good": lambda particles: next(reached),
        "my_recordings": _recordings,
    }  # fmt: skip


def _recordings() -> Iterator[tuple[str, int, SimpleNamespace]]:
    for index, split in enumerate(("train", "validation", "test")):
        made = make_trajectory(index)
        names = ("rgb", "depth", "intrinsics", "cam_to_world")
        yield split, index, SimpleNamespace(**{name: getattr(made, name) for name in names})


@pytest.mark.parametrize(("page", "index", "text"), BLOCKS, ids=[f"{page}-{index}" for page, index, _ in BLOCKS])
def test_a_block_runs(
    page: str, index: int, text: str, given: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code = compile(text.replace("num_steps=32", "num_steps=1"), f"{page}, block {index}", "exec")
    if any(words in text for words in NOT_RUN):
        return
    monkeypatch.chdir(tmp_path)
    (tmp_path / "released").symlink_to(ROOT / "released")
    space = dict(given) | {"vpd": vpd, "np": np, "torch": torch}
    exec(code, space)
    if "frames" in space:
        assert torch.isfinite(space["frames"]).all()
    if "write_manifest" in text:
        assert sorted(path.name for path in (tmp_path / "datasets" / "my_recording").iterdir()) == [
            "dataset.json", "test", "train", "validation",
        ]  # fmt: skip


def test_what_is_not_run_is_still_printed() -> None:
    assert not [words for words in NOT_RUN if not any(words in text for _, _, text in BLOCKS)]
