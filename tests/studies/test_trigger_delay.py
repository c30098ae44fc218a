"""The study of late cameras, in very small."""

import json
from pathlib import Path

import pytest

from data_gen.generate import generate
from docs.results.studies import trigger_delay


@pytest.mark.data
def test_a_late_camera_is_measured_with_every_sensor(tmp_path: Path) -> None:
    sizes = {"camera.height": 72, "camera.width": 72, "camera.num_views": 3, "num_frames": 100, "frame_time": 0.01}
    counts = {"splits.train": 2, "splits.validation": 0, "splits.test": 0}
    generate(
        "mujoco_block", "tiny", tmp_path / "mujoco_block", 0, renderer="raycast", workers=1, overrides=sizes | counts
    )
    out = tmp_path / "found.json"
    assert trigger_delay.main(["--root", str(tmp_path), "--out", str(out), "--scenes", "mujoco_block"]) == 0
    cells = json.loads(out.read_text())["cells"]
    assert set(cells) == {f"mujoco_block/{sensor}" for sensor in trigger_delay.SENSORS}
    for cell in cells.values():
        assert cell["planted_ms"] == pytest.approx(30)
        assert cell["found_ms"] == pytest.approx(30, abs=max(6, 4 * cell["error_ms"]))
        assert not cell["is_false_alarm"]
