"""Edits of what a trained model sees: the floor under a deleted block, and a world that is moved as a whole."""

import numpy as np
import pytest
import torch

import vpd_lightning as vpd
from tests.released_demo import demo_model, make_demo_data
from vpd_lightning.data.reader import TrajectoryReader
from vpd_lightning.editing.rotation import about_axis, matrix_of
from vpd_lightning.editing.selectors import Cluster, Everything
from vpd_lightning.viewer.opened_scene import OpenedScene, open_scene

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def opened(tmp_path_factory: pytest.TempPathFactory) -> OpenedScene:
    data = make_demo_data(tmp_path_factory.mktemp("demo") / "data")
    model = demo_model()
    return open_scene(model.simulator, data / "test" / "000000.h5", 4, model.input_views, "demo")


def empty_scene(opened: OpenedScene) -> np.ndarray:
    """The floor of each camera (view, height, width, 3): what most frames of three recordings show at a pixel."""
    frames = []
    for path in opened.path.parents[1].glob("*/*.h5"):
        with TrajectoryReader(path) as reader:
            frames.append(reader.rgb(range(reader.num_frames), range(reader.num_views)))
    return np.median(np.concatenate(frames), axis=0) / 255


def test_after_deleting_the_block_the_floor_is_seen_where_it_was(opened: OpenedScene) -> None:
    floor, truth = empty_scene(opened), opened.truth[0] / 255
    block = np.abs(truth - floor).max(axis=-1) > 0.25
    assert block.sum() > 200
    editor = vpd.SceneEditor(opened.scene)
    assert editor.num_clusters() == 1

    def error(scene: vpd.Scene) -> float:
        image = opened.simulator.render([scene.current], opened.cameras)[0].numpy()
        return float(np.abs(image - floor)[block].mean())

    with_block, without = error(opened.scene), error(editor.delete(Cluster(0)).scene)
    assert with_block > 0.2 and without < 0.35 * with_block
    # The rollout of what is left stands still: no block comes back.
    state = opened.simulator.rollout(editor.delete(Cluster(0)).scene, 8)[-1]
    assert torch.equal(
        state.positions[state.mask], opened.scene.current.positions[editor.delete(Cluster(0)).scene.current.mask]
    )


def test_moving_the_scene_moves_the_prediction_with_it(opened: OpenedScene) -> None:
    turn, shift = about_axis([0, 0, 1], 40), torch.tensor([0.3, -0.2, 0.1])
    moved = vpd.SceneEditor(opened.scene).move(Everything(), shift.tolist(), turn, about=[0, 0, 0]).scene
    here = opened.simulator.rollout(opened.scene, 8)
    there = opened.simulator.rollout(moved, 8)
    travelled = (here[-1].positions - opened.scene.current.positions).norm(dim=-1).max()
    assert travelled > 0.2
    apart = [
        float((moved_state.positions[0] - state.positions[0] @ matrix_of(turn).float().T - shift).norm(dim=-1).max())
        for state, moved_state in zip(here, there, strict=True)
    ]
    # Which points touch first is decided by the last digits: centimetres apart after contact.
    assert apart[1] < 0.01 * travelled and apart[-1] < 0.1 * travelled
