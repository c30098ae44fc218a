import os
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from data_gen import dataset_folder
from data_gen.importers import run
from data_gen.importers.formats import FORMATS, open_format
from data_gen.importers.run import import_recordings
from data_gen.importers.scene_bounds import SampledPoints, scene_bounds
from data_gen.importers.settings import ImportSettings, load_import_settings
from tests.data_gen.importers import known_scene
from tests.data_gen.importers.checks import TOLERANCE, assert_valid, attributes, camera_errors, files, worst_point
from tests.data_gen.importers.plain_recording import HEIGHT, WIDTH, write_plain
from tests.waiting import HANG, wait_until
from vpd_lightning.data.manifest import file_sha256, load_manifest
from vpd_lightning.data.reader import TrajectoryReader
from vpd_lightning.errors import ConfigError, DataError

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five recordings of four frames by two cameras."""
    folder = tmp_path_factory.mktemp("source") / "takes"
    for index in range(5):
        write_plain(folder / f"take{index}", num_frames=4, num_views=2, first=4 * index)
    return folder


@pytest.fixture(scope="module")
def imported(source: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return import_recordings(source, tmp_path_factory.mktemp("imported") / "set")


def contents(folder: Path) -> dict[str, str]:
    return {path.relative_to(folder).as_posix(): file_sha256(path) for path in files(folder)}


def test_manifest_names_every_file_and_its_checksum(imported: Path):
    manifest = load_manifest(imported)

    assert {split: len(paths) for split, paths in manifest.splits.items()} == {"train": 3, "validation": 1, "test": 1}
    assert manifest.sha256 == contents(imported)
    assert not list(imported.rglob(".*"))
    assert_valid(imported)


def test_split_depends_on_the_seed_alone(source: Path, imported: Path, tmp_path: Path):
    def division(folder: Path) -> dict[str, str]:
        return {str(attributes(path)["recording"]): path.parent.name for path in files(folder)}

    again = import_recordings(source, tmp_path / "again")
    seeds = [division(import_recordings(source, tmp_path / str(seed), {"seed": seed})) for seed in (1, 2, 3)]

    assert contents(again) == contents(imported)
    assert any(other != division(imported) for other in seeds)


def test_an_interrupted_import_resumes_to_the_same_files(
    source: Path, imported: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    written: list[Path] = []
    genuine = run._write_clip

    def stop_at_the_third(plan: Any, clip: Any, path: Path, scene_hash: str) -> None:
        if len(written) == 2:
            raise KeyboardInterrupt
        written.append(path)
        genuine(plan, clip, path, scene_hash)

    monkeypatch.setattr(run, "_write_clip", stop_at_the_third)
    with pytest.raises(KeyboardInterrupt):
        import_recordings(source, tmp_path / "set")
    assert files(tmp_path / "set") == sorted(written)
    with pytest.raises(
        DataError, match="(?s)unfinished data set made from other settings.*settings.height: 24 instead of None"
    ):
        import_recordings(source, tmp_path / "set", {"height": 24})
    monkeypatch.setattr(run, "_write_clip", genuine)
    before = {path: path.stat().st_mtime_ns for path in written}
    (tmp_path / "set" / "train" / ".000007.h5.x.partial").write_bytes(b"left by a killed process")

    import_recordings(source, tmp_path / "set")

    assert {path: path.stat().st_mtime_ns for path in written} == before
    assert contents(tmp_path / "set") == contents(imported)
    assert load_manifest(tmp_path / "set").digest == load_manifest(imported).digest
    assert not list((tmp_path / "set").rglob(".*"))
    assert "2 of 5 trajectories are there already" in capsys.readouterr().err


@pytest.mark.slow
def test_ctrl_c_leaves_whole_files_only(source: Path, imported: Path, tmp_path: Path):
    """A real process, hit while it writes; the next call finishes what is missing."""
    script = (
        "import time, signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from data_gen.importers import image_geometry as g, run\n"
        "slow = g.ImageGeometry.rgb\n"
        "g.ImageGeometry.rgb = lambda *a: (time.sleep(0.05), slow(*a))[1]\n"
        f"run.import_recordings({str(source)!r}, {str(tmp_path / 'set')!r})\n"
    )
    process = subprocess.Popen([sys.executable, "-c", script], cwd=ROOT, stderr=subprocess.PIPE, text=True)
    wait_until(lambda: files(tmp_path / "set"), process)
    os.kill(process.pid, signal.SIGINT)
    assert "KeyboardInterrupt" in process.communicate(timeout=HANG)[1]

    some = contents(tmp_path / "set")
    assert 0 < len(some) < 5
    assert not list((tmp_path / "set").rglob("*.partial"))
    assert not (tmp_path / "set" / "dataset.json").exists()
    assert contents(import_recordings(source, tmp_path / "set")) == contents(imported)


@pytest.mark.slow
def test_workers_change_nothing(source: Path, imported: Path, tmp_path: Path):
    assert contents(import_recordings(source, tmp_path / "set", {"workers": 2})) == contents(imported)


def test_a_finished_data_set_is_never_overwritten(source: Path, imported: Path, capsys: pytest.CaptureFixture[str]):
    before = contents(imported)

    import_recordings(source, imported)
    assert "complete already" in capsys.readouterr().out
    with pytest.raises(
        DataError, match="(?s)holds a finished data set made from other settings.*settings.height: 24 instead of None"
    ):
        import_recordings(source, imported, {"height": 24})
    assert contents(imported) == before


def test_another_source_of_the_same_name_is_refused(tmp_path: Path):
    first = write_plain(tmp_path / "a" / "take", num_frames=3, num_views=1)
    other = write_plain(tmp_path / "b" / "take", num_frames=3, num_views=1, frame_time=0.1)
    import_recordings(first, tmp_path / "set")

    with pytest.raises(DataError, match="made from other settings.*(?s:.*)cameras_and_frames"):
        import_recordings(other, tmp_path / "set")


def test_a_folder_with_other_files_is_refused(source: Path, tmp_path: Path):
    (tmp_path / "set" / "train").mkdir(parents=True)
    (tmp_path / "set" / "train" / "000000.h5").write_bytes(b"somebody else's")

    with pytest.raises(DataError, match="not from this run"):
        import_recordings(source, tmp_path / "set")
    assert (tmp_path / "set" / "train" / "000000.h5").read_bytes() == b"somebody else's"


def test_the_source_is_no_place_to_write(source: Path):
    for out in (source, source.parent):
        with pytest.raises(DataError, match="holds the source itself"):
            import_recordings(source, out)


def test_long_recordings_are_cut_and_their_clips_stay_together(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    for index in range(3):
        write_plain(tmp_path / "src" / f"take{index}", num_frames=14, num_views=1, first=100 * index)

    out = import_recordings(tmp_path / "src", tmp_path / "out", {"every": 2, "clip_frames": 3})

    intrinsics, poses = known_scene.cameras(1, HEIGHT, WIDTH)
    splits: dict[str, set[str]] = {}
    for path in files(out):
        found = attributes(path)
        splits.setdefault(str(found["recording"]), set()).add(path.parent.name)
        index, first = int(str(found["recording"])[-1]), int(found["source_first_frame"])
        assert first == 6 * found["clip"]
        times = [(100 * index + first + 2 * i) * known_scene.FRAME_TIME for i in range(3)]
        assert worst_point(path, times) < TOLERANCE
        assert found["frame_time"] == 2 * known_scene.FRAME_TIME and found["source_every"] == 2
        assert camera_errors(path, intrinsics, poses) == (0.0, 0.0)
    assert len(files(out)) == 6 and len(splits) == 3
    assert all(len(names) == 1 for names in splits.values())
    assert "the last 1 of 7 frames fill no clip" in capsys.readouterr().out


def test_bounds_are_estimated_and_said(
    imported: Path, source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    with TrajectoryReader(files(imported)[0]) as reader:
        low, high = np.array(reader.workspace_min), np.array(reader.workspace_max)
        near, far = reader.near, reader.far
        intrinsics, poses = reader.cameras([0])
        depth = reader.depth([0])[0]
        points, distances = [], []
        for view in range(2):
            seen = known_scene.unproject(depth[view], intrinsics[0, view], np.eye(4))
            distances.append(np.linalg.norm(seen, axis=1))
            points.append(seen @ poses[0, view, :3, :3].T + poses[0, view, :3, 3])
    joined = np.concatenate(points)
    inside = ((joined > low) & (joined < high)).all(axis=1)
    assert inside[joined[:, 2] > 0.05].mean() > 0.98  # the box
    far_floor = np.abs(joined[:, :2]).max(axis=1) > 1.5
    assert far_floor.sum() > 50
    assert not inside[far_floor].any()
    assert (np.concatenate(distances)[inside] > near).mean() > 0.999
    assert (np.concatenate(distances)[inside] < far).all()
    box = known_scene.box_pose(0.0)[:3, 3]
    assert (low < box - 0.4).all() and (high > box + 0.2).all()

    given = {"near": 0.5, "far": 6.0, "workspace_min": [-1, -1, -0.1], "workspace_max": [1, 1, 1.5]}
    capsys.readouterr()
    out = import_recordings(source, tmp_path / "out", {**given, "max_recordings": 1})
    with TrajectoryReader(files(out)[0]) as reader:
        assert (reader.near, reader.far, reader.workspace_min) == (0.5, 6.0, (-1.0, -1.0, -0.1))
    assert "estimated from" not in capsys.readouterr().out
    with pytest.raises(DataError, match="(?s)No measured point lies in the workspace.*The points reach from"):
        import_recordings(source, tmp_path / "far", {"workspace_min": [50, 50, 50], "workspace_max": [51, 51, 51]})


def test_a_ground_with_nothing_on_it_and_a_tilted_one_count_as_a_whole():
    rng = np.random.default_rng(0)
    floor = np.stack([rng.uniform(-3, 3, 9000), rng.uniform(-2, 2, 9000), rng.normal(0, 0.002, 9000)], axis=1)
    box = rng.uniform([0.1, 0.2, 0.0], [0.4, 0.5, 0.3], (900, 3))
    tilted = floor + np.stack([np.zeros(9000), np.zeros(9000), 0.3 * floor[:, 0]], axis=1)

    def bounds(positions: np.ndarray):
        points = SampledPoints(positions, np.full(len(positions), 2.0))
        return scene_bounds(points, np.zeros(3), ImportSettings())

    for whole in (floor, np.concatenate([tilted, box])):
        found = bounds(whole)
        assert found.ground is None
        assert found.workspace_min[0] < -2.9
    cut = bounds(np.concatenate([floor, box]))
    assert cut.ground == pytest.approx(0.0, abs=1e-3)
    assert -0.35 < cut.workspace_min[0] < -0.15  # 0.3 m of room, and 5 %
    assert 0.7 < cut.workspace_max[0] < 0.85
    assert cut.workspace_max[2] == pytest.approx(0.3, abs=0.1)


def test_stray_measurements_do_not_stretch_the_workspace(source: Path, imported: Path, tmp_path: Path):
    folder = write_plain(tmp_path / "takes" / "take0", num_frames=4, num_views=2, depth="npy")
    for file in folder.glob("*/depth/*.npy"):
        depth = np.load(file)
        depth.ravel()[::400] = 500.0
        depth.ravel()[7::400] = np.nan
        np.save(file, depth)
    out = import_recordings(tmp_path / "takes", tmp_path / "out")
    with TrajectoryReader(files(out)[0]) as reader, TrajectoryReader(files(imported)[0]) as clean:
        assert np.abs(np.array(reader.workspace_max) - clean.workspace_max).max() < 0.6
        assert reader.far < 2 * clean.far
        assert np.isfinite(reader.depth()).all()


def test_one_recording_says_what_is_missing(source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    import_recordings(source, tmp_path / "one", {"max_recordings": 1})
    said = capsys.readouterr().out
    import_recordings(source, tmp_path / "two", {"max_recordings": 2})

    assert "1 recording: nothing is left for validation and test" in said and "Import more recordings" in said
    assert "2 recordings: nothing is left for test" in capsys.readouterr().out
    counts = {split: len(paths) for split, paths in load_manifest(tmp_path / "two").splits.items()}
    assert counts == {"train": 1, "validation": 1, "test": 0}


def test_splits_of_the_source_are_kept(tmp_path: Path):
    for name, split in (("a", "test"), ("b", "train"), ("c", "validation")):
        write_plain(tmp_path / "src" / name, num_frames=3, num_views=1, split=split)
    out = import_recordings(tmp_path / "src", tmp_path / "out")

    assert {attributes(path)["recording"]: path.parent.name for path in files(out)} == {
        "a": "test",
        "b": "train",
        "c": "validation",
    }


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"neer": 1}, "Unknown setting 'neer'; did you mean 'near'"),
        ({"splits.trian": 1}, "did you mean 'splits.train'"),
        ({"every": 0}, "every is 0; allowed: a whole number from 1 on"),
        ({"every": "two"}, "every: .*could not be converted"),
        ({"axes": "blender"}, "axes is blender; allowed: auto, opencv, opengl"),
        ({"pixel_center": 0.25}, "pixel_center is 0.25; allowed: auto, 0.5, 0.0"),
        ({"near": 3.0, "far": 2.0}, "near < far"),
        ({"crop": [0, 0, 4, 4]}, "crop is"),
        ({"workspace_min": [0, 0]}, "three numbers"),
        ({"workspace_min": [0, 0, 0], "workspace_max": [1, 1, 0]}, "min below max"),
        ({"clip_frames": 2}, "3 or more"),
        ({"splits": {"train": 0, "validation": 0, "test": 0}}, "not all 0"),
        ({"format": "plane"}, "did you mean 'plain'"),
        ({"scale": -1.0}, "scale is -1.0; allowed: above 0"),
        ({"compression": "zip"}, "allowed: .*lzf"),
    ],
)
def test_wrong_settings_are_named(source: Path, tmp_path: Path, changes: dict[str, Any], message: str):
    with pytest.raises(ConfigError, match=message):
        import_recordings(source, tmp_path / "out", changes)
    assert not (tmp_path / "out").exists()


def test_a_number_is_taken_for_a_word_where_words_are_allowed():
    assert load_import_settings({"pixel_center": 0}).pixel_center == "0.0"


def test_too_short_recordings_are_refused(source: Path, tmp_path: Path):
    with pytest.raises(DataError, match="(?s)the longest has 2 frames with every=2.*static scene"):
        import_recordings(source, tmp_path / "out", {"every": 2})
    with pytest.raises(DataError, match="clip_frames=9; the longest has 4"):
        import_recordings(source, tmp_path / "out", {"clip_frames": 9})


def test_recordings_of_different_shapes_are_refused(tmp_path: Path):
    write_plain(tmp_path / "src" / "a", num_frames=3, num_views=1)
    write_plain(tmp_path / "src" / "b", num_frames=3, num_views=2)

    with pytest.raises(DataError, match="1 views of 64x48 in a; 2 views of 64x48 in b"):
        import_recordings(tmp_path / "src", tmp_path / "out")


def test_full_disks_and_memories_are_noticed_before_writing(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(dataset_folder.shutil, "disk_usage", lambda path: SimpleNamespace(free=2**20))
    with pytest.raises(DataError, match="GiB free; 5 trajectories need"):
        import_recordings(source, tmp_path / "out")
    monkeypatch.undo()
    monkeypatch.setattr(run.os, "sysconf", lambda name: 64)
    with pytest.raises(DataError, match="(?s)GiB of memory.*clip_frames"):
        import_recordings(source, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_many_remarks_are_cut_short(source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    import_recordings(source, tmp_path / "out", {"clip_frames": 3})

    said = capsys.readouterr().out
    assert said.count("fill no clip") == 4 and "... and 1 more recordings like these." in said


def test_unknown_sources_list_the_formats(tmp_path: Path):
    with pytest.raises(
        DataError, match=r"(?s)none of the formats that can be imported: plain, .*lerobot\.\ndocs/your_data.md"
    ):
        open_format(tmp_path, "auto")
    with pytest.raises(DataError, match="There is no"):
        open_format(tmp_path / "nothing", "auto")
    for name in FORMATS:
        assert callable(open_format(tmp_path, name)[1].recordings)


def test_a_folder_that_looks_like_two_formats_asks(tmp_path: Path):
    write_plain(tmp_path / "take", num_frames=3, num_views=1)
    (tmp_path / "take" / "transforms.json").write_text("{}")

    with pytest.raises(ConfigError, match="plain and transforms. Say which: format=plain"):
        import_recordings(tmp_path / "take", tmp_path / "out")


def test_no_depth_at_all_is_refused(tmp_path: Path):
    folder = write_plain(tmp_path / "take", num_frames=3, num_views=1, depth="npy")
    for file in folder.glob("*/depth/*.npy"):
        np.save(file, np.zeros((HEIGHT, WIDTH), np.float32))

    with pytest.raises(DataError, match="Not one of the sampled pixels has a depth"):
        import_recordings(folder, tmp_path / "out")
