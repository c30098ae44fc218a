"""Recordings simulated anew from one frame on, with bodies changed."""

from pathlib import Path

import h5py
import mujoco
import numpy as np
import pytest

from data_gen.counterfactual import Change, family_of, run_counterfactual, simulate
from data_gen.mujoco_block.counterfactual import begin
from data_gen.mujoco_block.settings import MujocoBlockSettings
from data_gen.settings import load_settings
from tests.released_demo import make_demo_data
from vpd_lightning.data.manifest import Manifest, load_manifest
from vpd_lightning.errors import DataError

FRAME, GRAVITY = 4, np.array([0.0, 0.0, -9.81])


@pytest.fixture(scope="module")
def manifest(tmp_path_factory: pytest.TempPathFactory) -> Manifest:
    return load_manifest(make_demo_data(tmp_path_factory.mktemp("counterfactual") / "data"))


def path_of(manifest: Manifest) -> Path:
    return manifest.split("test")[0]


def recorded(manifest: Manifest, frames: slice) -> np.ndarray:
    with h5py.File(path_of(manifest)) as file:
        return file["rgb"][frames]


def blue(pictures: np.ndarray) -> int:
    red, green, other = (pictures[..., channel].astype(int) for channel in range(3))
    return int(((other - red > 60) & (other - green > 40)).sum())


def test_without_a_change_it_is_the_recording(manifest: Manifest) -> None:
    pictures = simulate(manifest, path_of(manifest), FRAME, {}, 6)
    assert np.array_equal(pictures, recorded(manifest, slice(FRAME, FRAME + 7)))


def test_a_block_that_is_gone_leaves_the_floor_without_a_shadow(manifest: Manifest) -> None:
    pictures = simulate(manifest, path_of(manifest), FRAME, {0: Change(is_gone=True)}, 2)
    assert blue(recorded(manifest, slice(FRAME, FRAME + 3))) > 100 and blue(pictures) == 0
    assert np.array_equal(pictures[0], pictures[2])  # an empty floor
    assert pictures[0, 0].mean(axis=-1).min() > 0.8 * np.median(pictures[0, 0].mean(axis=-1))


def started(manifest: Manifest, change: Change | None):
    settings = load_settings(MujocoBlockSettings, "mujoco_block", "demo", {})
    path = path_of(manifest)
    with h5py.File(path) as file:
        attributes = dict(file.attrs)
    model, data, renderer = begin(settings, attributes, path, FRAME, {} if change is None else {0: change})
    renderer.close()
    return settings, model, data


def test_a_block_moves_as_it_is_told(manifest: Manifest) -> None:
    settings, _, untouched = started(manifest, None)
    half = np.sqrt(0.5)
    change = Change(shift=(0.0, 0.0, 0.5), turn=(half, 0.0, 0.0, half), about=(1.0, 0.0, 0.0))
    _, _, turned = started(manifest, change)
    x, y, z = untouched.qpos[:3]
    assert turned.qpos[:3] == pytest.approx((1 - y, x - 1, z + 0.5))  # a quarter turn about an upright axis
    vx, vy, vz = untouched.qvel[:3]
    assert turned.qvel[:3] == pytest.approx((-vy, vx, vz)) and turned.qvel[3:] == pytest.approx(untouched.qvel[3:])

    velocity = np.array((0.05, -0.03, 0.1))
    _, model, thrown = started(manifest, Change(velocity=velocity.tolist()))
    before = thrown.qpos[:3].copy()
    mujoco.mj_step(model, thrown, settings.substeps)
    # It moved by ``velocity`` over the frame before: by as much and a frame's fall over the next.
    falls = velocity + GRAVITY * settings.frame_time**2
    assert thrown.qpos[:3] - before == pytest.approx(falls, abs=2e-3) and np.abs(thrown.qvel[3:]).max() < 1e-9


def test_a_process_of_its_own_draws_the_same(manifest: Manifest) -> None:
    change = {0: Change(velocity=(0.05, 0.0, 0.1))}
    apart = run_counterfactual(manifest, path_of(manifest), FRAME, change, 2)
    assert np.array_equal(apart, simulate(manifest, path_of(manifest), FRAME, change, 2))


def test_what_cannot_be_simulated_is_said(manifest: Manifest) -> None:
    imported = Manifest(**{**vars(manifest), "generator": "vpd-data import"})
    assert family_of(manifest) == "mujoco_block" and family_of(imported) is None
    assert family_of(Manifest(**{**vars(manifest), "preset": "of_somebody_else"})) is None
    with pytest.raises(DataError, match="cannot be simulated anew"):
        run_counterfactual(imported, path_of(manifest), FRAME, {}, 1)
    other = Manifest(**{**vars(manifest), "settings": {**manifest.settings, "timestep": 0.005}})
    with pytest.raises(DataError, match="off the recording"):
        simulate(other, path_of(manifest), FRAME, {}, 1)
