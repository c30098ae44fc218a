"""``vpd-render`` from its words to its files, and what it refuses."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.evaluation.tossed_box import CAM_TO_WORLD, INTRINSICS, SIZE, write_tossed_boxes
from tests.evaluation.untrained_model import write_untrained
from tests.released_model import write_slotformer
from vpd_lightning.commands.render import main


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("render")
    return write_untrained(folder / "run", write_tossed_boxes(folder / "data", num_train=1, num_test=2))


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def num_frames(path: Path) -> int:
    return int(cv2.VideoCapture(str(path)).get(cv2.CAP_PROP_FRAME_COUNT))


def test_recorded_cameras_are_compared_with_the_truth(checkpoint: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert main([f"ckpt={checkpoint}", "camera=all", "num_steps=4", "trajectory=1", f"out={out}"]) == 0
    films = [f"camera_0{view}{kind}" for view in range(2) for kind in (".png", ".webm", "_comparison.webm")]
    assert names(out) == sorted([*films, "contact_sheet.png", "particles", "particles.png", "render.json"])
    assert num_frames(out / "camera_01.webm") == num_frames(out / "camera_01_comparison.webm") == 5
    assert names(out / "particles") == sorted(f"000{step}.{kind}" for step in range(5) for kind in ("npz", "ply"))
    described = json.loads((out / "render.json").read_text())
    assert described["trajectory"] == "test/000001.h5" and described["films"] == ["camera_00.webm", "camera_01.webm"]


def test_particles_are_the_predicted_ones(checkpoint: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert main([f"ckpt={checkpoint}", "camera=0", "num_steps=2", "save_particles=[npz]", f"out={out}"]) == 0
    first, last = (np.load(out / "particles" / f"000{step}.npz") for step in (0, 2))
    assert np.array_equal(first["positions"], last["positions"]), "this model lets nothing move"
    assert first["colors"].dtype == np.uint8 and len(first["colors"]) == len(first["positions"]) == len(
        first["features"]
    )


def test_a_rollout_may_outlast_the_recording(checkpoint: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    words = ["camera=input", "num_steps=30", "start_frame=3", "save_particles=[]", f"out={out}"]
    assert main([f"ckpt={checkpoint}", *words]) == 0
    assert names(out) == ["camera_00.png", "camera_00.webm", "particles.png", "render.json"]
    assert num_frames(out / "camera_00.webm") == 31


def test_a_ring_films_at_any_size(checkpoint: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    words = ["camera=ring", "num_steps=3", "height=40", "width=60", "save_particles=[]", f"out={out}"]
    assert main([f"ckpt={checkpoint}", *words]) == 0
    assert names(out) == ["particles.png", "render.json", "ring.png", "ring.webm"]
    image = cv2.imread(str(out / "ring.png"))
    assert image.shape[0] / image.shape[1] == pytest.approx(40 / 60)


@pytest.mark.parametrize(("moving", "expected"), [(False, ["novel_00.webm", "novel_01.webm"]), (True, ["path.webm"])])
def test_cameras_of_a_file(checkpoint: Path, tmp_path: Path, moving: bool, expected: list[str]) -> None:
    cameras = [
        {"intrinsics": k.tolist(), "cam_to_world": p.tolist()} for k, p in zip(INTRINSICS, CAM_TO_WORLD, strict=True)
    ]
    content = {"height": SIZE, "width": SIZE, "moving": moving, "cameras": cameras}
    (tmp_path / "cameras.json").write_text(json.dumps(content))
    out = tmp_path / "out"
    words = [f"camera={tmp_path}/cameras.json", "num_steps=1", "save_particles=[]", f"out={out}"]
    assert main([f"ckpt={checkpoint}", *words]) == 0
    assert [name for name in names(out) if name.endswith(".webm")] == expected


def test_a_file_with_the_recorded_camera_gives_the_same_film(checkpoint: Path, tmp_path: Path) -> None:
    camera = {"intrinsics": INTRINSICS[1].tolist(), "cam_to_world": CAM_TO_WORLD[1].tolist()}
    (tmp_path / "one.json").write_text(json.dumps({"height": SIZE, "width": SIZE, "cameras": [camera]}))
    for camera_word, out in ((f"{tmp_path}/one.json", "a"), ("1", "b")):
        words = [f"camera={camera_word}", "num_steps=1", "save_particles=[]", f"out={tmp_path}/{out}"]
        assert main([f"ckpt={checkpoint}", *words]) == 0
    assert (tmp_path / "a" / "novel_00.png").read_bytes() == (tmp_path / "b" / "camera_01.png").read_bytes()


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (["camera=[0,7]"], 2, "no camera 7: the recording has 2"),
        (["camera=sideways"], 2, "camera=sideways means nothing"),
        (["camera=none.json"], 3, "no camera file none.json"),
        (["trajectory=9"], 2, "no trajectory 9"),
        (["start_frame=9"], 3, "has 10 frames"),
        (["num_steps=0"], 2, "num_steps=0"),
        (["fps=0"], 2, "fps=0"),
        (["height=0"], 2, "height=0"),
        (["save_particles=[obj]"], 2, "'obj'"),
        (["split=tests"], 3, "split 'tests'"),
        (["camra=ring"], 2, "camra"),
    ],
)
def test_bad_words_get_a_named_error(
    checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], code: int, message: str
) -> None:
    assert main([f"ckpt={checkpoint}", "num_steps=1", f"out={tmp_path}/out", *words]) == code
    error = capsys.readouterr().err
    assert message in error and len(error.strip().splitlines()) <= 5
    assert not list(tmp_path.iterdir()), "nothing stays behind"


def test_a_system_that_predicts_its_own_views_is_not_filmed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_slotformer(tmp_path / "run")
    assert main([f"ckpt={path}", "num_steps=1"]) == 2
    assert "vpd-eval" in capsys.readouterr().err
