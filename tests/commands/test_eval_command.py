"""``vpd-eval`` from its words to its files, and what it refuses."""

import hashlib
import json
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

import vpd_lightning
from tests.evaluation.tossed_box import write_tossed_boxes
from tests.evaluation.untrained_model import write_untrained
from tests.released_model import write_slotformer
from vpd_lightning.commands.eval import main
from vpd_lightning.config import compose
from vpd_lightning.errors import ConfigError
from vpd_lightning.runs.evaluation_run import choose_protocol, run_evaluation, training_of
from vpd_lightning.training.checkpoint_files import load_checkpoint


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tossed_boxes(tmp_path_factory.mktemp("data"))


@pytest.fixture
def checkpoint(tmp_path: Path, data: Path) -> Path:
    return write_untrained(tmp_path / "run", data)


def test_an_evaluation_writes_everything_and_prints_its_path_last(
    checkpoint: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([f"ckpt={checkpoint}", "num_videos=1", "protocol.num_trajectories=1"]) == 0
    lines = capsys.readouterr().out.splitlines()
    folder = checkpoint.parents[1] / "evaluation"
    assert lines[-1] == str(folder / "metrics.json")
    assert sorted(path.name for path in folder.iterdir()) == [
        "arrays.npz",
        "config.yaml",
        "contact_sheet.png",
        "curves.png",
        "index.html",
        "metrics.csv",
        "metrics.json",
        "rollouts.npz",
        "videos",
    ]
    page = (folder / "index.html").read_text()
    shown = re.findall(r'src="([^"]+)"', page)
    assert {"curves.png", "contact_sheet.png"} < set(shown) and any(name.endswith(".webm") for name in shown)
    assert all((folder / name).is_file() for name in shown) and "://" not in page
    assert page.index("<video") < page.index("last frame repeated") < page.index("curves.png")
    assert page.count("autoplay loop muted") == page.count("<video") >= 1
    metrics = json.loads((folder / "metrics.json").read_text())
    assert f"{metrics['psnr']['per_step'][2]:.4g}" in page and "moving pixels (dB)" in page
    assert metrics["step"] == 7 and len(metrics["checkpoint_sha256"]) == len(metrics["data_sha256"]) == 64
    assert (metrics["system"], metrics["experiment"], metrics["seed"]) == ("vpd", metrics["model"], 0)
    assert metrics["num_parameters"] == sum(p.numel() for p in vpd_lightning.load(checkpoint).parameters()) > 0
    assert metrics["native"] is None and metrics["penetration"]["mean"] >= 0 and metrics["sharpness"]["mean"] > 0
    assert yaml.safe_load((folder / "config.yaml").read_text()) == load_checkpoint(checkpoint)["hyper_parameters"]
    assert metrics["training"]["checkpoint_name"] == "last.ckpt" and metrics["training"]["seconds"] is None
    assert metrics["protocol"]["num_steps"] == 3, "the run's own protocol"
    # Nothing moves in this model, so it is as wrong as predicting no motion.
    assert metrics["motion"]["centroid_error_over_copy"]["per_step"] == pytest.approx([1.0] * 3)
    assert metrics["long_rollout"]["num_steps"] == 20


def test_the_time_is_that_of_the_checkpoint() -> None:
    content = {
        "callbacks": {"TimeBudget": {"seconds": 90.0, "seconds_before": 30.0, "steps": 12}},
        "hyper_parameters": {"callbacks": {"time_budget": {"minutes": 2.0, "clock": "cpu"}}},
        "global_step": 12,
        "data_sha256": ["ab" * 32],
    }
    assert training_of(content, Path("run/checkpoints/best.ckpt")) == {
        "seconds": 120.0,
        "seconds_before": 30.0,
        "minutes_allowed": 2.0,
        "clock": "cpu",
        "steps": 12,
        "checkpoint_name": "best.ckpt",
        "data_sha256": "ab" * 32,
    }
    both = {**content, "data_sha256": ["a", "b"]}
    assert training_of(both, Path("a.ckpt"))["data_sha256"] == ["a", "b"]
    assert training_of({"hyper_parameters": {"callbacks": None}}, Path("a.ckpt"))["seconds"] is None


def test_a_system_without_particles_is_evaluated_as_well(
    tmp_path: Path, data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_slotformer(tmp_path / "run")
    words = [f"ckpt={path}", f"data.folder={data}", "num_videos=1", "protocol.num_steps=3"]
    assert main([*words, "protocol.start_frames=[2]"]) == 2
    assert "looks at 6 frames" in capsys.readouterr().err
    assert main([*words, "protocol.start_frames=[4]"]) == 0
    metrics = json.loads((tmp_path / "run" / "evaluation" / "metrics.json").read_text())
    assert metrics["system"] == "slotformer" and metrics["native"]["resolution"] == 16
    assert metrics["finite"] and metrics["chamfer"] is None and metrics["psnr"]["count"] == 3 * 2 * 3
    assert "at its own 16x16 pixels" in capsys.readouterr().out


def test_a_model_that_predicts_depth_is_evaluated_without_any(tmp_path: Path, data: Path) -> None:
    depth = ("encoder=unet_depth_small", "encoder.channels=[4,8,4]", "encoder.initial_depth=1.9")
    path = write_untrained(tmp_path / "run", data, *depth)
    words = [f"ckpt={path}", "hide_depth=true", "num_videos=0", "protocol.num_trajectories=1"]
    assert main([*words, "protocol.num_long_steps=0"]) == 0
    metrics = json.loads((tmp_path / "run" / "evaluation" / "metrics.json").read_text())
    assert metrics["hide_depth"] is True and metrics["finite"] and metrics["chamfer"]["mean"] > 0


def test_a_second_evaluation_does_not_overwrite_the_first(checkpoint: Path) -> None:
    words = [
        f"ckpt={checkpoint.parents[1]}",
        "num_videos=0",
        "protocol.num_trajectories=1",
        "protocol.num_long_steps=0",
    ]
    assert main(words) == main(words) == 0
    run = checkpoint.parents[1]
    first, second = (json.loads((run / name / "metrics.json").read_text()) for name in ("evaluation", "evaluation_2"))
    assert first["psnr"] == second["psnr"], "an evaluation repeats exactly"


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (["protocol.split=tests"], 2, "no split 'tests'"),
        (["protocol.split=validation"], 3, "split 'validation'"),
        (["protocol.num_steps=60"], 3, "num_steps"),
        (["protocol.num_step=6"], 2, "num_step"),
        (["num_videos=-1"], 2, "num_videos=-1"),
        (["num_threads=0"], 2, "num_threads=0"),
        (["device=tpu9"], 2, "device"),
        (["hide_depth=true"], 3, "no measured pixel"),
        (["data.folder=nowhere"], 3, "vpd-data generate"),
        (["out={folder}"], 2, "exists already"),
    ],
)
def test_bad_words_get_a_named_error(
    checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], code: int, message: str
) -> None:
    words = [word.format(folder=tmp_path) for word in words]
    assert main([f"ckpt={checkpoint}", "num_videos=0", *words]) == code
    error = capsys.readouterr().err
    assert message in error and len(error.strip().splitlines()) <= 5
    assert [path.name for path in checkpoint.parents[1].iterdir()] == ["checkpoints"], "nothing stays behind"


@pytest.mark.parametrize("is_made", [True, False])
def test_a_data_set_that_is_gone_is_made_again_where_the_training_would_make_it(
    tmp_path: Path, data: Path, monkeypatch: pytest.MonkeyPatch, is_made: bool
) -> None:
    gone = tmp_path / "gone"
    words = ["generate.scene=mujoco_block", f"generate.when_missing={is_made}"]
    checkpoint = write_untrained(tmp_path / "run", gone, *words)
    asked: list[Path] = []

    def provide(config: Mapping[str, Any], only: tuple[str, int] | None) -> Path:
        assert only is None  # an evaluation needs the whole set
        asked.append(Path(config["data"]["folder"]))
        gone.symlink_to(data)
        return gone

    monkeypatch.setattr("vpd_lightning.runs.one_recording.provide_data", provide)
    code = main([f"ckpt={checkpoint}", "num_videos=0", "protocol.num_trajectories=1", "protocol.num_long_steps=0"])
    assert (code, asked) == ((0, [gone]) if is_made else (3, []))


def test_a_training_can_be_followed_by_its_evaluation(
    checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [f"ckpt='{checkpoint}'", f"out='{tmp_path / 'here'}'", "num_videos=0", "protocol.num_long_steps=0"]
    path = run_evaluation(compose("eval", words))
    assert path == tmp_path / "here" / "metrics.json" and path.is_file()
    assert "PSNR (dB)" in capsys.readouterr().out


def test_a_missing_checkpoint_is_a_checkpoint_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([f"ckpt={tmp_path}/none.ckpt"]) == 4
    assert "There is no checkpoint" in capsys.readouterr().err


def test_wrong_input_views_are_refused(tmp_path: Path, data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    checkpoint = write_untrained(tmp_path / "run", data, "scene.input_views=[0,5]")
    assert main([f"ckpt={checkpoint}", "num_videos=0"]) == 2
    assert "reads views [0, 5]" in capsys.readouterr().err


PROTOCOL = {
    "split": "test", "start_frames": [4], "num_steps": 8, "num_trajectories": 16, "num_long_steps": 0,
    "long_start_frame": 0, "moving_threshold": 0.1, "min_moving_pixels": 10, "body_margin": 0.02,
    "num_chamfer_points": 100, "num_bootstrap": 10,
}  # fmt: skip


def test_a_value_that_is_set_replaces_that_of_the_run() -> None:
    protocol = choose_protocol({**dict.fromkeys(PROTOCOL), "num_steps": 2}, PROTOCOL)
    assert protocol.num_steps == 2 and protocol.num_trajectories == 16


def test_a_whole_protocol_takes_nothing_from_the_run() -> None:
    assert choose_protocol({**PROTOCOL, "num_trajectories": None}, PROTOCOL).num_trajectories is None


def test_a_run_from_before_a_setting_is_evaluated_without_it() -> None:
    older = {key: value for key, value in PROTOCOL.items() if key != "draw_references"}
    wanted = dict.fromkeys([*PROTOCOL, "draw_references"])
    assert not choose_protocol(wanted, older).draw_references
    assert choose_protocol({**wanted, "draw_references": True}, older).draw_references
    whole = {**PROTOCOL, "num_trajectories": None, "draw_references": None}
    assert choose_protocol(whole, {**older, "num_trajectories": 3}).num_trajectories is None
    assert not choose_protocol(whole, None).draw_references


def test_a_run_without_protocol_needs_one() -> None:
    with pytest.raises(ConfigError, match="protocol=paper"):
        choose_protocol(dict.fromkeys(PROTOCOL), None)


class Opened:
    """Counts how often a file is opened, by whatever means: Python tells its audit hooks, which stay for good."""

    def __init__(self, path: Path) -> None:
        self.path, self.count = str(path), 0
        sys.addaudithook(self._hear)

    def _hear(self, event: str, arguments: tuple[Any, ...]) -> None:
        if event == "open" and str(arguments[0]) == self.path:
            self.count += 1


@pytest.mark.parametrize("is_folder", [False, True])
def test_a_checkpoint_is_read_and_checked_and_hashed_once(
    checkpoint: Path, monkeypatch: pytest.MonkeyPatch, is_folder: bool
) -> None:
    """Of a run folder, too, where the newest whole checkpoint is looked for first."""
    size, loaded, hashed = checkpoint.stat().st_size, [], []
    load, sha256 = torch.load, hashlib.sha256

    def counted_load(*words: Any, **options: Any) -> Any:
        loaded.append(words)
        return load(*words, **options)

    def counted_sha256(content: Any = b"", **options: Any) -> Any:
        hashed.extend([len(content)] if len(content) > size // 2 else [])
        return sha256(content, **options)

    monkeypatch.setattr(torch, "load", counted_load)
    monkeypatch.setattr(hashlib, "sha256", counted_sha256)
    opened = Opened(checkpoint)
    place = checkpoint.parents[1] if is_folder else checkpoint
    assert main([f"ckpt={place}", "num_videos=0", "protocol.num_trajectories=1", "protocol.num_long_steps=0"]) == 0
    assert (opened.count, len(loaded)) == (1, 1) and len(hashed) <= 1
    metrics = json.loads((checkpoint.parents[1] / "evaluation" / "metrics.json").read_text())
    assert metrics["checkpoint_sha256"] == sha256(checkpoint.read_bytes()).hexdigest()
