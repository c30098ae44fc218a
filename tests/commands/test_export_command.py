"""``vpd-export`` from its words to its folder, what other commands do with it, and what it refuses."""

import json
from pathlib import Path

import pytest
import torch

from tests.evaluation.tossed_box import write_tossed_boxes
from tests.released_model import figures, write_run
from vpd_lightning.commands import eval as evaluation
from vpd_lightning.commands import export, info
from vpd_lightning.data.clip import read_clip
from vpd_lightning.errors import CheckpointError
from vpd_lightning.evaluation.prediction import encode_clip
from vpd_lightning.geometry.cameras import pixel_rays
from vpd_lightning.loading import load_model
from vpd_lightning.release.release_folder import check_release, sha256
from vpd_lightning.training.checkpoint_files import write_checkpoint
from vpd_lightning.types import Rays

RELEASED = Path(__file__).parents[2] / "released" / "mujoco_block_vpd"  # a program has no scenery


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tossed_boxes(tmp_path_factory.mktemp("data"))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, data: Path) -> Path:
    """A run folder; tests must leave it as it is."""
    return write_run(tmp_path_factory.mktemp("runs") / "run", data).parents[1]


def test_a_run_becomes_a_folder_that_other_commands_take(
    run: Path, data: Path, in_folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert export.main([f"ckpt={run}", "out=released/boxes"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "released/boxes"
    before = {path.name: path.stat().st_mtime_ns for path in (in_folder / "released" / "boxes").iterdir()}
    words = [f"data.folder={data}", "num_videos=0", "protocol.num_trajectories=1", "protocol.num_long_steps=0"]
    assert evaluation.main(["ckpt=released/boxes", *words]) == 0
    metrics = json.loads((in_folder / "runs" / "boxes" / "evaluation" / "metrics.json").read_text())
    index = json.loads((in_folder / "released" / "boxes" / "release.json").read_text())
    assert metrics["checkpoint_sha256"] == index["sha256"]["model.safetensors"] and metrics["step"] == 7
    assert {path.name: path.stat().st_mtime_ns for path in (in_folder / "released" / "boxes").iterdir()} == before

    monkeypatch.setattr(info, "_gl_backends", lambda: {"egl": None})
    capsys.readouterr()
    info.main([])
    said = capsys.readouterr().out
    assert "released/boxes" in said and f"{index['num_parameters']:,} parameters" in said and "25.12 dB" in said
    (in_folder / "released" / "boxes" / "model.safetensors").write_bytes(b"")
    info.main([])
    assert "model.safetensors is damaged" in capsys.readouterr().out


@pytest.mark.slow
def test_a_release_may_hold_its_renderer_as_a_program(in_folder: Path, data: Path) -> None:
    model = load_model(RELEASED)
    weights = {f"simulator.{name}": value for name, value in model.simulator.state_dict().items()}
    checkpoint = in_folder / "run" / "checkpoints" / "last.ckpt"
    write_checkpoint({"state_dict": weights, "hyper_parameters": model.config, "global_step": 7}, checkpoint)
    (in_folder / "run" / "evaluation").mkdir()
    (in_folder / "run" / "evaluation" / "metrics.json").write_text(json.dumps(figures(checkpoint, data)))
    assert export.main(["ckpt=run", "out=released/boxes", "renderer_program=100"]) == 0
    program = torch.export.load(in_folder / "released" / "boxes" / "renderer.pt2").module()
    simulator = load_model(in_folder / "released" / "boxes").simulator
    clip = read_clip(data / "test" / "000000.h5", 0, 0, num_steps=0, with_state=False)
    particles = encode_clip(simulator, clip, [0, 1]).current
    rays = pixel_rays(clip.cameras[0, 0])
    chosen = Rays(*(part.reshape(1, -1, 3)[:, 200:300] for part in (rays.origins, rays.directions)))
    with torch.no_grad():
        drawn = simulator.renderer(particles, chosen, None)
    colors, _, _ = program(particles.positions, particles.features, particles.mask, chosen.origins, chosen.directions)
    torch.testing.assert_close(colors, drawn.rgbs, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (["out=here"], 2, "ckpt"),
        (["ckpt={run}"], 2, "out"),
        (["ckpt={run}", "out={run}"], 2, "exists already"),
        (["ckpt={run}/none.ckpt", "out=here"], 4, "There is no checkpoint"),
        (["ckpt={run}", "out=here", "metrics=none.json"], 2, "no model is released without"),
        (["ckpt={run}", "out=here", "max_megabytes=0.01"], 2, "max_megabytes"),
        (["ckpt={run}", "out=here", "max_megabytes=0"], 2, "out of range"),
        (["ckpt={run}", "out=here", "metric=x"], 2, "metric"),
        (["ckpt={run}", "out=here", "renderer_program=0"], 2, "renderer_program=0"),
        (["ckpt={run}", "out=here", "renderer_program=8"], 2, "PointNeRFRenderer cannot be exported"),
    ],
)
def test_bad_words_get_a_named_error(
    run: Path, in_folder: Path, fails, words: list[str], code: int, message: str
) -> None:
    assert message in fails(export.main, [word.format(run=run) for word in words], code)


def test_a_release_is_not_released_again(run: Path, in_folder: Path, fails) -> None:
    assert export.main([f"ckpt={run}", "out=released/boxes"]) == 0
    assert "released model already" in fails(export.main, ["ckpt=released/boxes", "out=again"], 2)
    words = ["ckpt=released/boxes", "out=again", "renderer_program=8"]
    assert "Leave metrics out" in fails(export.main, [*words, "metrics=some.json"], 2)
    assert "PointNeRFRenderer cannot be exported" in fails(export.main, words, 2)
    assert not (in_folder / "again").exists()


@pytest.mark.slow
def test_a_copy_of_a_release_gets_its_renderer_as_a_program(in_folder: Path, fails) -> None:
    assert export.main([f"ckpt={RELEASED}", "out=copy", "renderer_program=8"]) == 0
    copy, source = check_release(in_folder / "copy"), check_release(RELEASED)
    program = (in_folder / "copy" / "renderer.pt2").read_bytes()
    assert copy["sha256"] == source["sha256"] | {"renderer.pt2": sha256(program)}
    assert {**copy, "sha256": None} == {**source, "sha256": None}
    load_model(in_folder / "copy")
    (in_folder / "copy" / "renderer.pt2").write_bytes(program[:-1])
    with pytest.raises(CheckpointError, match=r"renderer\.pt2 is damaged"):
        check_release(in_folder / "copy")
    (in_folder / "copy" / "renderer.pt2").unlink()
    with pytest.raises(CheckpointError, match=r"renderer\.pt2 is missing"):
        check_release(in_folder / "copy")
    words = ["out=small", "renderer_program=8"]
    assert "renderer.pt2 is missing" in fails(export.main, ["ckpt=copy/model.safetensors", *words], 4)
    assert "max_megabytes" in fails(export.main, [f"ckpt={RELEASED}", *words, "max_megabytes=0.1"], 2)


def test_a_program_that_the_index_does_not_name_is_a_fault(run: Path, in_folder: Path) -> None:
    assert export.main([f"ckpt={run}", "out=released/boxes"]) == 0
    (in_folder / "released" / "boxes" / "renderer.pt2").write_bytes(b"strange")
    with pytest.raises(CheckpointError, match="does not name it"):
        check_release(in_folder / "released" / "boxes")


def test_help(capsys: pytest.CaptureFixture[str], in_folder: Path) -> None:
    assert export.main(["--help"]) == 0
    assert "Exit codes" in capsys.readouterr().out
