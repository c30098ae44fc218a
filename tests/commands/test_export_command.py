"""``vpd-export`` from its words to its folder, what other commands do with it, and what it refuses."""

import json
from pathlib import Path

import pytest

from tests.evaluation.tossed_box import write_tossed_boxes
from tests.released_model import write_run
from vpd_lightning.commands import eval as evaluation
from vpd_lightning.commands import export, info


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
    ],
)
def test_bad_words_get_a_named_error(
    run: Path, in_folder: Path, fails, words: list[str], code: int, message: str
) -> None:
    assert message in fails(export.main, [word.format(run=run) for word in words], code)


def test_a_release_is_not_released_again(run: Path, in_folder: Path, fails) -> None:
    assert export.main([f"ckpt={run}", "out=released/boxes"]) == 0
    assert "released model already" in fails(export.main, ["ckpt=released/boxes", "out=again"], 2)


def test_help(capsys: pytest.CaptureFixture[str], in_folder: Path) -> None:
    assert export.main(["--help"]) == 0
    assert "Exit codes" in capsys.readouterr().out
