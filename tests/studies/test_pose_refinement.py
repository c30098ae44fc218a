"""What refining poses does, measured in very small."""

import json
from pathlib import Path

import pytest

from data_gen.generate import generate
from docs.results.studies import pose_refinement


@pytest.mark.data
def test_misplaced_cameras_are_measured_before_and_after(tmp_path: Path) -> None:
    sizes = {"camera.height": 96, "camera.width": 128, "camera.num_views": 3, "num_frames": 3}
    counts = {"splits.train": 1, "splits.validation": 0, "splits.test": 1}
    folder = tmp_path / "mujoco_block_240"
    generate("mujoco_block", "tiny", folder, 0, renderer="raycast", workers=1, overrides=sizes | counts)
    out = tmp_path / "found.json"
    assert pose_refinement.main(["--root", str(tmp_path), "--out", str(out)]) == 0
    cells = json.loads(out.read_text())["cells"]
    assert set(cells) == {f"mujoco_block/{sensor}" for sensor in pose_refinement.SENSORS}
    for cell in cells.values():
        assert cell["num_cameras"] == 2
        assert 0.1 < cell["given_percent"] < 5
    assert cells["mujoco_block/none"]["refined_percent"] < cells["mujoco_block/none"]["given_percent"]
