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


def test_one_moment_is_filmed_from_a_ring(checkpoint: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    words = ["camera=ring", "freeze_step=3", "num_views=5", "save_particles=[ply]", f"out={out}"]
    assert main([f"ckpt={checkpoint}", *words]) == 0
    assert names(out) == ["contact_sheet.png", "particles", "particles.png", "render.json", "ring.png", "ring.webm"]
    assert num_frames(out / "ring.webm") == 5
    assert names(out / "particles") == ["0003.ply"]
    described = json.loads((out / "render.json").read_text())
    assert described["freeze_step"] == 3 and described["num_steps"] == 3


def test_one_moment_of_the_recordings_cameras_is_compared_with_the_truth(checkpoint: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    words = ["camera=all", "freeze_step=2", "save_maps=[depth]", "save_particles=[]", f"out={out}"]
    assert main([f"ckpt={checkpoint}", *words]) == 0
    pictures = [f"camera_0{view}{kind}" for view in range(2) for kind in (".png", "_maps.npz")]
    assert names(out) == sorted([*pictures, "contact_sheet.png", "particles.png", "render.json"])
    assert json.loads((out / "render.json").read_text())["films"] == []
    # Truth, prediction, error and depth below each other, 256 pixels and more each; a bar on top and one with labels.
    assert cv2.imread(str(out / "contact_sheet.png")).shape[0] > 4 * 256


def test_films_are_written_in_the_formats_that_were_asked_for(checkpoint: Path, tmp_path: Path) -> None:
    words = [f"ckpt={checkpoint}", "camera=0", "num_steps=2", "save_particles=[]"]
    assert main([*words, "save_films=[webp,gif]", f"out={tmp_path}/loops"]) == 0
    films = [f"camera_00{kind}.{end}" for kind in ("", "_comparison") for end in ("gif", "webp")]
    assert sorted(path.name for path in (tmp_path / "loops").iterdir()) == sorted(
        [*films, "camera_00.png", "contact_sheet.png", "particles.png", "render.json"]
    )
    described = json.loads((tmp_path / "loops" / "render.json").read_text())["films"]
    assert described == ["camera_00.webp", "camera_00.gif"]
    assert main([*words, "save_films=[]", f"out={tmp_path}/none"]) == 0
    assert sorted(path.name for path in (tmp_path / "none").iterdir()) == [
        "camera_00.png", "contact_sheet.png", "particles.png", "render.json",
    ]  # fmt: skip
    assert main([*words, "save_films=[avi]", f"out={tmp_path}/never"]) == 2
    assert not (tmp_path / "never").exists()


def test_a_frozen_moment_is_the_same_as_in_the_film(checkpoint: Path, tmp_path: Path) -> None:
    words = [f"ckpt={checkpoint}", "camera=1", "save_maps=[depth,opacity]", "save_particles=[npz]"]
    assert main([*words, "num_steps=3", f"out={tmp_path}/film"]) == 0
    assert main([*words, "freeze_step=2", f"out={tmp_path}/moment"]) == 0
    film, moment = (np.load(tmp_path / name / "camera_01_maps.npz") for name in ("film", "moment"))
    assert film["depth"].shape == (4, SIZE, SIZE) and film["depth"].dtype == np.float32
    assert np.array_equal(film["depth"][2], moment["depth"][0])
    assert np.array_equal(film["opacity"][2], moment["opacity"][0])
    assert np.allclose(film["cam_to_world"], CAM_TO_WORLD[1], atol=1e-6) and film["intrinsics"].shape == (4, 3, 3)
    assert num_frames(tmp_path / "film" / "camera_01_depth.webm") == 4
    assert num_frames(tmp_path / "film" / "camera_01_opacity.webm") == 4
    particles = [np.load(tmp_path / name / "particles" / "0002.npz")["positions"] for name in ("film", "moment")]
    assert np.array_equal(*particles)


def test_a_written_camera_path_films_the_same_again(checkpoint: Path, tmp_path: Path) -> None:
    words = [f"ckpt={checkpoint}", "num_steps=2", "save_particles=[]", "save_maps=[depth]"]
    assert main([*words, "camera=ring", "save_camera_path=true", f"out={tmp_path}/ring"]) == 0
    written = tmp_path / "ring" / "camera_path.json"
    assert len(json.loads(written.read_text())["camera_path"]) == 3
    assert main([*words, f"camera={written}", f"out={tmp_path}/path"]) == 0
    ring, path = (np.load(tmp_path / f) for f in ("ring/ring_maps.npz", "path/path_maps.npz"))
    assert np.allclose(ring["depth"], path["depth"], atol=1e-4)
    assert np.allclose(ring["cam_to_world"], path["cam_to_world"], atol=1e-6)
    assert np.allclose(ring["intrinsics"], path["intrinsics"], atol=1e-4)


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
        (["save_maps=[normals]"], 2, "'normals'"),
        (["save_maps=[depth,depth]"], 2, "a word twice"),
        (["freeze_step=-1"], 2, "freeze_step=-1"),
        (["freeze_step=1", "num_views=0", "camera=ring"], 2, "num_views=0"),
        (["num_views=4", "camera=ring"], 2, "freeze_step=STEP"),
        (["freeze_step=1", "num_views=4"], 2, "camera=ring"),
        (["save_camera_path=true", "width=40", "camera=ring"], 2, "save_camera_path=false"),
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
