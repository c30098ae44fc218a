"""Public recordings of real cameras, as far as they are at hand: imported, judged, and rolled out.

``VPD_PUBLIC_RECORDINGS`` names a folder of what ``docs/results/studies/real_recordings.py`` reads; without it these
tests are skipped. The repositories state no licence, so nothing of them is here.
"""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from data_gen.inspection.validate import check_dataset
from docs.results.studies import real_recordings
from vpd_lightning.commands import data
from vpd_lightning.config import build_simulator, compose
from vpd_lightning.data.clip import read_clip
from vpd_lightning.data.manifest import load_manifest
from vpd_lightning.evaluation.prediction import encode_clip

SOURCE = os.environ.get("VPD_PUBLIC_RECORDINGS", "")
NEEDED = {"fruit": "fruta1", "two_cameras": "chocapics", "room": "data"}
FAULTS: dict[str, set[str]] = {
    "fruit": set(),  # one camera that stands still: nothing contradicts it
    "two_cameras": {"free_space"},  # a wall two metres off, 4 to 9 cm apart in the two sensors
    "room": set(),
}
START = {"fruit": 24, "two_cameras": 0, "room": 10}

pytestmark = pytest.mark.skipif(not SOURCE, reason="VPD_PUBLIC_RECORDINGS names no folder")


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    folder = tmp_path_factory.mktemp("public")
    real_recordings.main([SOURCE, str(folder)])
    yield folder


@pytest.mark.parametrize("name", NEEDED)
def test_a_public_recording_is_imported_judged_and_rolled_out(name: str, plain: Path, tmp_path: Path) -> None:
    if not (Path(SOURCE) / NEEDED[name]).is_dir():
        pytest.skip(f"{NEEDED[name]} is not there")
    out = tmp_path / name
    words = ["import", str(plain / name), f"out={out}", "height=96"]
    words += ["splits.train=1", "splits.validation=0", "splits.test=0"]
    assert data.main(words + (["refine_poses=true"] if name == "two_cameras" else [])) == 0

    assert {fault.name for fault in check_dataset(out).faults if fault.is_error} == FAULTS[name]

    config = compose("train", ["run.folder=unused", "experiment=recordings", f"data.folder={out}"])
    simulator = build_simulator(config).eval()
    clip = read_clip(load_manifest(out).split("train")[0], 0, START[name], 8)
    with torch.no_grad():
        scene = encode_clip(simulator, clip, list(config["scene"]["input_views"]))
        states = simulator.rollout(scene, 8)
        images = simulator.render([states[0], states[7]], clip.target_cameras[0].to("cpu", torch.float32))
    assert all(bool(state.positions.isfinite().all()) for state in states) and bool(images.isfinite().all())
    assert scene.current.scenery is not None and scene.current.moving is not None
    measured = int((clip.depth[1] > 0).sum())
    assert int(scene.current.scenery.mask.sum()) > measured / 2, "a table, walls and a floor are most of every picture"
