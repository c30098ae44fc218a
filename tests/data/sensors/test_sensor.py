"""Simulated sensors against what was measured on real ones."""

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from data_gen.settings import load_preset, preset_names, scene_names
from tests.data_gen.blocks import contents, generate_small
from tests.training.tiny_training import tiny_data
from vpd_lightning.data.clip import read_clip
from vpd_lightning.data.ground_truth import read_state
from vpd_lightning.data.reader import TrajectoryReader
from vpd_lightning.data.sensors import Sensor, load_sensor, sensor_names
from vpd_lightning.data.sensors.sensor import median_depth
from vpd_lightning.errors import ConfigError
from vpd_lightning.evaluation.motion import true_points

INTRINSICS = np.array([[120.0, 0.0, 80.0], [0.0, 120.0, 60.0], [0.0, 0.0, 1.0]])
# Temporal standard deviation of a static pixel on real recordings: distance in metres, lowest and highest % of it.
MEASURED = {
    "structured_light": [(0.75, 0.07, 0.10), (1.25, 0.11, 0.15), (2.0, 0.16, 0.22), (3.25, 0.30, 0.44)],
    "active_stereo": [(0.75, 0.14, 0.19), (1.25, 0.22, 0.29), (2.0, 0.60, 0.70), (3.25, 0.80, 1.00)],
}


def sensor(name="structured_light", seed=0, trajectory="train/000000", median=1.0, **changes):
    settings = load_sensor(name, changes)
    assert settings is not None
    return Sensor(settings, seed=seed, trajectory=trajectory, median_depth=median)


def wall(distance, height=120, width=160):
    return np.full((height, width), distance, np.float32)


def relative_errors(camera, distance, frames=24):
    seen = np.stack([camera.measure_depth(wall(distance), INTRINSICS, frame, 0) for frame in range(frames)])
    return np.where(seen > 0, seen / distance - 1, np.nan)


@pytest.mark.parametrize("name", list(MEASURED))
def test_noise_over_time_grows_with_distance_as_measured(name):
    for distance, low, high in MEASURED[name]:
        deviation = 100 * np.nanmedian(np.nanstd(relative_errors(sensor(name), distance), axis=0))
        assert low < deviation < high, f"{distance} m"


@pytest.mark.parametrize("name", ["structured_light", "active_stereo", "time_of_flight"])
@pytest.mark.parametrize("percent", [0.1, 0.5, 1.0])
def test_noise_is_scaled_to_a_percentage_at_the_median_depth(name, percent):
    # 7 m as in MOVi: what counts is the percentage, not the distance.
    errors = relative_errors(sensor(name, median=7.0, percent_at_median=percent), 7.0)

    assert 100 * np.nanmedian(np.nanstd(errors, axis=0)) == pytest.approx(percent, rel=0.15)


def test_neighbours_err_alike_and_distant_pixels_do_not():
    errors = relative_errors(sensor(median=2.0, percent_at_median=0.5), 2.0)
    at = [np.nanmean(errors[..., step:] * errors[..., : errors.shape[-1] - step]) for step in (0, 1, 6)]

    # A smoothed field: exp(-1 / (4 length^2)) at one pixel, 0.50 for 0.6, a little more for a sampled kernel.
    assert at[1] / at[0] == pytest.approx(0.5, abs=0.1)
    assert abs(at[2] / at[0]) < 0.05


@pytest.mark.parametrize("name", ["structured_light", "active_stereo"])
def test_as_many_pixels_as_measured_have_no_depth_and_holes_mostly_stay(name):
    # 5 to 11 % on real recordings.
    holes = np.isnan(relative_errors(sensor(name), 1.0, 12))
    expected = sensor(name).settings.hole_share

    assert 0.05 <= expected <= 0.11
    assert holes.mean() == pytest.approx(expected, abs=0.03)
    assert (holes[0] & holes[1]).sum() > 0.3 * holes[0].sum()  # by chance 6 %


def test_edges_lose_pixels_and_pixels_fly_between_near_and_far():
    depth = wall(2.0)
    depth[30:90, 40:120] = 1.0
    seen = np.stack([sensor(hole_share=0).measure_depth(depth, INTRINSICS, frame, 0) for frame in range(8)])
    inner = np.zeros(depth.shape, bool)
    inner[32:88, 42:118] = True
    inner[:28], inner[92:], inner[:, :38], inner[:, 122:] = True, True, True, True

    assert not (seen[:, inner] == 0).any()
    assert (seen[:, ~inner] == 0).mean() > 0.05
    assert ((seen > 1.05) & (seen < 1.9)).sum() > 0
    assert not ((seen > 1.05) & (seen < 1.9))[:, inner].any()


def test_a_plane_seen_at_an_angle_has_no_edges_but_a_bias_where_it_is_grazed():
    rows = (np.arange(120) + 0.5 - INTRINSICS[1, 2]) / INTRINSICS[1, 1]
    for slope, is_biased in ((1.0, False), (8.0, True)):
        depth = np.repeat((2.0 / (1 - slope * rows))[:, None], 160, axis=1)
        depth = np.where((depth > 0.3) & (depth < 4), depth, 0).astype(np.float32)
        quiet = sensor(hole_share=0, edge_dropout=0, flying_share=0)
        seen = np.stack([quiet.measure_depth(depth, INTRINSICS, frame, 0) for frame in range(16)])
        error = np.median(seen.mean(axis=0)[depth > 1.5] - depth[depth > 1.5])
        assert (abs(error) > 0.01) == is_biased


def test_depth_comes_in_steps():
    quiet = {"noise_percent": [1e-6, 2e-6, 3e-6, 4e-6], "hole_share": 0, "disparity_step": 0, "depth_step": 0.01}
    depth = np.linspace(1, 2, 120 * 160, dtype=np.float32).reshape(120, 160)

    seen = sensor(**quiet, edge_dropout=0, flying_share=0, grazing_bias=0).measure_depth(depth, INTRINSICS, 0, 0)

    assert np.allclose(100 * seen, np.rint(100 * seen), atol=1e-4)
    assert np.abs(seen - depth).max() < 0.0051


def test_errors_depend_on_seed_trajectory_frame_and_view_alone():
    first = sensor().measure_depth(wall(1.0), INTRINSICS, 3, 1)
    others = [
        sensor(seed=1).measure_depth(wall(1.0), INTRINSICS, 3, 1),
        sensor(trajectory="train/000001").measure_depth(wall(1.0), INTRINSICS, 3, 1),
        sensor().measure_depth(wall(1.0), INTRINSICS, 4, 1),
        sensor().measure_depth(wall(1.0), INTRINSICS, 3, 2),
    ]

    assert (sensor().measure_depth(wall(1.0), INTRINSICS, 3, 1) == first).all()
    assert not any((other == first).all() for other in others)


def test_colours_and_poses_err_as_much_as_is_said():
    grey = np.full((60, 80, 3), 128, np.uint8)
    pictures = np.stack([sensor(exposure_percent=0).measure_rgb(grey, frame, 0) for frame in range(4)])
    poses = np.stack([sensor(pose_offset=0.005, pose_degrees=0.2).measure_pose(np.eye(4), v) for v in range(200)])

    assert pictures.std() == pytest.approx(255 * 0.01, rel=0.1)
    assert poses[:, :3, 3].std() == pytest.approx(0.005, rel=0.15)
    assert np.allclose(poses[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1), np.eye(3), atol=1e-12)
    assert np.degrees(poses[:, 1, 0]).std() == pytest.approx(0.2, rel=0.2)
    assert (sensor().measure_pose(np.eye(4), 0) == np.eye(4)).all()


def test_mistyped_sensors_and_settings_are_named():
    with pytest.raises(ConfigError, match="did you mean 'active_stereo'"):
        load_sensor("active-stereo")
    with pytest.raises(ConfigError, match="did you mean 'hole_share'"):
        load_sensor("active_stereo", {"holeshare": 0.1})
    with pytest.raises(ConfigError, match="hole_share is 2"):
        load_sensor("active_stereo", {"hole_share": 2.0})
    assert load_sensor("none") is None and "none" in sensor_names()


@pytest.fixture(scope="module")
def clean(tmp_path_factory) -> Path:
    return generate_small(tmp_path_factory.mktemp("clean") / "set")


@pytest.fixture(scope="module")
def noisy(tmp_path_factory) -> Path:
    return generate_small(tmp_path_factory.mktemp("noisy") / "set", sensor="active_stereo")


def test_generated_files_hold_errors_and_the_truth_beside_them(clean, noisy):
    with TrajectoryReader(clean / "train/000000.h5") as true, TrajectoryReader(noisy / "train/000000.h5") as seen:
        state = read_state(noisy / "train/000000.h5")
        assert state.depth is not None and state.cam_to_world is not None
        assert (state.depth == true.depth()).all() and (state.cam_to_world == true.cameras()[1][0]).all()
        assert not (seen.depth() == true.depth()).all() and not (seen.rgb() == true.rgb()).all()
        clip = read_clip(noisy / "train/000000.h5", 0, 0, 1)
        assert (clip.true_depth(1)[0].numpy() == true.depth([2])[0]).all()
        assert (clip.true_depth(0)[0].numpy() == true.depth([1])[0]).all()
        assert (true_points(clip, 0, 64) == true_points(read_clip(clean / "train/000000.h5", 0, 0, 1), 0, 64)).all()
        assert (state.segmentation == read_state(clean / "train/000000.h5").segmentation).all()
    assert read_state(clean / "train/000000.h5").depth is None


def test_the_perfect_sensor_changes_no_byte(clean, tmp_path):
    assert contents(generate_small(tmp_path / "set", sensor="none")) == contents(clean)


@pytest.mark.slow
def test_workers_change_nothing(noisy, tmp_path):
    assert contents(generate_small(tmp_path / "set", sensor="active_stereo", workers=2)) == contents(noisy)


def test_late_cameras_see_what_the_frames_in_between_show(tmp_path):
    only_late = {
        "noise_percent": [1e-6, 2e-6, 3e-6, 4e-6], "hole_share": 0, "disparity_step": 0, "depth_step": 0,
        "edge_dropout": 0, "flying_share": 0, "grazing_bias": 0, "exposure_percent": 0, "color_noise": 0,
        "trigger_offset": 0.03, "trigger_steps": 4,
    }  # fmt: skip
    words = {f"sensor.{key}": value for key, value in only_late.items()}
    folder = generate_small(tmp_path / "late", sensor="structured_light", **{"camera.num_views": 3, **words})
    path = folder / "train/000000.h5"
    state = read_state(path)
    with TrajectoryReader(path) as reader:
        assert state.depth is not None and reader.num_frames == len(state.positions) == len(state.depth) == 4
        settings = load_sensor("structured_light", only_late)
        errors = Sensor(settings, seed=0, trajectory="train/000000", median_depth=1.0)
        late = [errors.trigger_step(view, reader.frame_time) for view in range(3)]
        changed = [not np.allclose(reader.depth()[:, v], state.depth[:, v], rtol=1e-5) for v in range(3)]
    assert any(late) and changed == [step > 0 for step in late]


def test_what_cannot_be_triggered_late_is_said(tmp_path, clean):
    with pytest.raises(ConfigError, match="trigger_steps=7 does not divide"):
        generate_small(
            tmp_path / "x", sensor="active_stereo", **{"sensor.trigger_offset": 0.01, "sensor.trigger_steps": 7}
        )
    with pytest.raises(ConfigError, match="longer than a frame time"):
        generate_small(tmp_path / "x", sensor="active_stereo", **{"sensor.trigger_offset": 5.0})
    with pytest.raises(ConfigError, match=r"add sensor=NAME"):
        generate_small(tmp_path / "x", **{"sensor.trigger_offset": 0.01})


def test_cameras_of_every_scene_can_be_triggered_late_as_shipped():
    presets = [(scene, preset) for scene in scene_names() for preset in preset_names(scene)]
    assert len(presets) >= 30
    for scene, preset in presets:
        _, settings = load_preset(scene, preset)
        substeps = round(settings.frame_time / settings.timestep)
        for name in sensor_names():
            sensor = load_sensor(name, {})
            assert sensor is None or substeps % sensor.trigger_steps == 0, (scene, preset, name)


def test_training_clips_get_the_errors_and_validation_clips_do_not(clean):
    def clips(**changes):
        return tiny_data(clean, num_steps=1, num_steps_schedule=None, num_validation_steps=1,
                         num_validation_clips=1, moving_ray_fraction=0.0, **changes)  # fmt: skip

    perfect, noisy = clips(), clips(sensor="structured_light", sensor_percent=0.5)
    kept = clips(sensor="structured_light", sensor_percent=0.5, cache=False)
    first, second, third = (data.clip_dataset(4)[1] for data in (perfect, noisy, kept))
    again = pickle.loads(pickle.dumps(kept.clip_dataset(4)))[1]  # as a loader worker gets it

    assert not (first.depth == second.depth).all() and not (first.rgb == second.rgb).all()
    assert (second.depth == third.depth).all() and (third.depth == again.depth).all()
    seen = second.depth > 0
    error = (second.depth[seen] / first.depth[seen] - 1).abs().median().item()
    assert 0.1 < 100 * error / 0.6745 < 1.0  # a median of absolute values is 0.67 standard deviations
    assert perfect.validation is not None and noisy.validation is not None
    assert (perfect.validation[0].context.depth == noisy.validation[0].context.depth).all()


def test_late_cameras_need_data_made_for_them(clean):
    data = tiny_data(clean, sensor="structured_light")
    assert data.sensor is not None
    data.sensor = replace(data.sensor, trigger_offset=0.01)
    with pytest.raises(ConfigError, match="vpd-data generate"):
        data.setup()


def test_the_median_depth_leaves_out_what_is_missing_or_beyond():
    depth = np.array([0, 1, 2, 3, 50, np.nan], np.float32)
    assert median_depth(depth, 10.0) == 2.0 and median_depth(depth[:1], 10.0) == 0.0
