"""The run for GPU machines: its CPU rehearsal, resuming, and parts that fail."""

import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import gpu, gpu_parts, stages
from benchmarks.measuring import Result, row
from benchmarks.results_files import read, write

REHEARSE = ["--device", "cpu", "--rehearse"]


@pytest.mark.slow
@pytest.mark.benchmarks
def test_rehearsed_part_is_measured_once(tmp_path: Path, capsys: pytest.CaptureFixture):
    arguments = [*REHEARSE, "--only", "frames", "--out", str(tmp_path)]

    assert gpu.main(arguments) == 0
    written = (tmp_path / "gpu_frames_cpu.json").read_bytes()
    first = capsys.readouterr().out
    assert gpu.main(arguments) == 0

    assert "frames: done" in first
    assert "surface/float32" in first
    assert "frames: already there" in capsys.readouterr().out
    assert (tmp_path / "gpu_frames_cpu.json").read_bytes() == written


@pytest.mark.slow
@pytest.mark.benchmarks
@pytest.mark.parametrize("part", ["dynamics", "train_step"])
def test_every_variant_of_a_part_can_be_rehearsed(part: str, tmp_path: Path):
    assert gpu.main([*REHEARSE, "--only", part, "--out", str(tmp_path)]) == 0

    rows = read(tmp_path / f"gpu_{part}_cpu.json")["rows"]
    assert any("compiled" in item.name for item in rows)
    assert all(item.seconds is not None for item in rows)


@pytest.mark.slow
@pytest.mark.benchmarks
def test_rehearsed_feature_kernel_agrees_with_float64(tmp_path: Path):
    pytest.importorskip("triton")

    assert gpu.main([*REHEARSE, "--only", "features", "--out", str(tmp_path)]) == 0

    rows = {item.name: item for item in read(tmp_path / "gpu_features_cpu.json")["rows"]}
    assert rows["forward/triton"].error < 1e-5  # float32 sums over 16 neighbours
    assert rows["forward and backward/triton"].error < 1e-4  # gradients sum over samples, in another order


@pytest.mark.slow
@pytest.mark.benchmarks
def test_part_that_fails_leaves_its_traceback_and_fails_the_run(tmp_path: Path):
    missing = tmp_path / "no_such_file.json"

    code = gpu.main([*REHEARSE, "--only", "frames", "--out", str(tmp_path), "--stages", str(missing)])

    assert code == 1
    assert "no_such_file.json" in (tmp_path / "gpu_frames_cpu.failed.txt").read_text()
    assert not (tmp_path / "gpu_frames_cpu.json").exists()


def test_part_that_ends_early_leaves_its_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys):
    def interrupted(options):
        yield Result([row("frames/first", [0.5])])
        raise RuntimeError("no more memory")

    monkeypatch.setattr(gpu_parts, "frames", interrupted)

    with pytest.raises(RuntimeError, match="no more memory"):
        gpu.main([*REHEARSE, "--part", "frames", "--out", str(tmp_path)])

    assert read(tmp_path / "gpu_frames_partial_cpu.json")["rows"][0].seconds == 0.5
    assert not (tmp_path / "gpu_frames_cpu.json").exists()
    monkeypatch.setattr(gpu, "_in_own_process", lambda *_: "not done")
    assert gpu.main([*REHEARSE, "--only", "frames", "--out", str(tmp_path)]) == 1
    assert "frames, as far as it got" in capsys.readouterr().out


def test_variant_that_failed_inside_a_part_fails_the_run(tmp_path: Path, capsys: pytest.CaptureFixture):
    import torch

    result = Result([row("train_step/compiled", note="failed: TypeError")], {"compiled failed": "Traceback ..."})
    write("gpu_train_step", torch.device("cpu"), result, tmp_path)

    assert gpu.main([*REHEARSE, "--only", "train_step", "--out", str(tmp_path)]) == 1
    assert "train_step: compiled failed" in capsys.readouterr().out


def test_parts_need_neither_hydra_nor_lightning():
    script = "import benchmarks.gpu_parts, sys; print(*{name.partition('.')[0] for name in sys.modules})"

    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)

    assert done.returncode == 0, done.stderr
    assert not set(done.stdout.split()) & {"hydra", "omegaconf", "lightning", "h5py", "mujoco", "cv2", "matplotlib"}


def test_cpu_is_for_rehearsals_only():
    with pytest.raises(SystemExit):
        gpu.main(["--device", "cpu"])


def test_prepared_settings_are_those_of_the_configuration(tmp_path: Path):
    path = tmp_path / "stages.json"
    subprocess.run([sys.executable, "-m", "benchmarks.stages", str(path)], check=True)
    script = (
        "import sys; sys.modules['yaml'] = None\n"
        "from pathlib import Path; from benchmarks import stages\n"
        f"stages.use_prepared(Path({str(path)!r}))\n"
        "print(sorted(stages.settings('renderer/surface', 'mujoco').items()))"
    )

    found = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)

    assert found.stdout.strip() == str(sorted(stages.settings("renderer/surface", "mujoco").items())), found.stderr


def test_settings_are_those_that_hydra_composes():
    from vpd_lightning.config import compose

    config = compose("train", ["renderer=point_nerf_small", "dynamics=hierarchical_gnn_small", "data.folder=x"])

    assert stages.settings("renderer/point_nerf_small", "mujoco") == config["renderer"]
    assert stages.settings("dynamics/hierarchical_gnn_small", "mujoco") == config["dynamics"]
    assert stages.settings("encoder/unet", "mujoco") == config["encoder"]
