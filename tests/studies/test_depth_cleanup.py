"""What cleaning does to depth, measured in very small."""

import json
from pathlib import Path

import pytest

from data_gen.generate import generate
from docs.results.studies import depth_cleanup


@pytest.mark.data
def test_every_way_of_cleaning_is_measured_for_every_sensor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(depth_cleanup, "FRAMES", (0, 2))
    sizes = {"camera.height": 192, "camera.width": 256, "camera.num_views": 1, "num_frames": 3}
    counts = {"splits.train": 1, "splits.validation": 0, "splits.test": 1}
    folder = tmp_path / "mujoco_block_480"
    generate("mujoco_block", "tiny", folder, 0, renderer="raycast", workers=1, overrides=sizes | counts)
    out = tmp_path / "found.json"
    assert depth_cleanup.main(["--root", str(tmp_path), "--out", str(out)]) == 0
    cells = json.loads(out.read_text())["cells"]
    assert set(cells) == {f"mujoco_block/{sensor}" for sensor in depth_cleanup.SENSORS}
    for cell in cells.values():
        assert cell["height=96"]["error_percent"] < cell[depth_cleanup.MIDDLE]["error_percent"]
        assert cell["smooth=2"]["error_percent"] < cell["as measured"]["error_percent"]
        assert cell["flying_pixels=0.02"]["measured_percent"] > cell["as measured"]["measured_percent"] - 2
