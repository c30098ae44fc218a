"""Edits in the viewer as MuJoCo would make them."""

from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("viser")

from data_gen.counterfactual import Change
from tests.released_demo import demo_model, make_demo_data
from vpd_lightning.data.manifest import load_manifest
from vpd_lightning.editing.operations import Delete, Duplicate, Move, Scale, SetVelocity
from vpd_lightning.editing.selectors import Box, Cluster, Everything, Not
from vpd_lightning.viewer.captions import figures
from vpd_lightning.viewer.counterfactual import can_simulate, changes_of, counterfactual
from vpd_lightning.viewer.opened_scene import OpenedScene, open_scene
from vpd_lightning.viewer.screen import Screen
from vpd_lightning.viewer.session import Session, picture_psnr

BLOCK = Cluster(0)


@pytest.fixture(scope="module")
def opened(tmp_path_factory: pytest.TempPathFactory) -> OpenedScene:
    model, manifest = demo_model(), load_manifest(make_demo_data(tmp_path_factory.mktemp("counterfactual") / "data"))
    path = manifest.split("test")[0]
    return open_scene(model.simulator, path, 2, model.input_views, "demo", manifest.scene, manifest)


def test_edits_of_whole_bodies_are_told_to_mujoco(opened: OpenedScene) -> None:
    assert can_simulate(opened)
    assert changes_of(opened, [Delete(BLOCK)]) == {0: Change(is_gone=True)}
    half = float(np.sqrt(0.5))
    turn = Move(BLOCK, (0.0, 0.0, 0.0), (half, 0.0, 0.0, half), (1.0, 0.0, 0.0))
    both = changes_of(opened, [SetVelocity(BLOCK, (0.1, 0.0, 0.0)), Move(BLOCK, (0.0, 0.0, 0.2)), turn])
    assert both is not None and both[0].velocity == pytest.approx((0.0, 0.1, 0.0), abs=1e-6)
    point = np.array([0.3, 0.2, 0.5])
    assert both[0].moved(point) == pytest.approx((1 - 0.2, 0.3 - 1, 0.7), abs=1e-6)


@pytest.mark.parametrize(
    "operation",
    [
        Delete(Not(BLOCK)),
        Delete(Everything()),
        Delete(Box([-9, -9, -9], [0, 9, 9])),
        Duplicate(BLOCK, (0.5, 0, 0)),
        Scale(BLOCK, 1.5),
    ],
    ids=["floor", "all", "half", "copy", "larger"],
)
def test_other_edits_are_none_of_mujocos(opened: OpenedScene, operation: object) -> None:
    assert changes_of(opened, [operation]) is None and counterfactual(opened, [operation], 1) is None


def test_the_thrown_block_is_seen_beside_mujocos_own_and_compared(opened: OpenedScene) -> None:
    session = Session(opened)
    camera = SimpleNamespace(image_height=600, image_width=900)
    screen = Screen(SimpleNamespace(camera=camera), session)
    session.apply(SetVelocity(BLOCK, (0.05, 0.02, 0.06)), "thrown")
    session.simulate(3)
    assert screen.true_picture(2) is None and "MuJoCo" not in figures(screen, 2, False)
    pictures = counterfactual(opened, session.operations(), 3)
    assert pictures is not None and pictures.shape == (4, *opened.truth.shape[1:])
    session.now.true_pictures = pictures
    predicted = session.render(2, opened.cameras[:1])[0]
    opened.frames.put((session.now.number, 2, screen.view, screen.film_rows[0]), predicted)
    near, far = picture_psnr(predicted, pictures[2, 0]), picture_psnr(predicted, opened.truth[2, 0])
    assert near > far + 3  # the edit, and not the recording, is what it is like
    assert f"MuJoCo's own simulation: PSNR **{near:.2f} dB**" in figures(screen, 2, False)
    # On a telephone the panes stand above the panel.
    narrow = Screen(SimpleNamespace(camera=SimpleNamespace(image_height=840, image_width=390)), session)
    layout = narrow._layout(3, 1.0)
    assert layout.height > 2 * (max(top for top, _ in layout.corners) + layout.pane_height)
    assert np.array_equal(screen.true_picture(2), pictures[2, screen.view]) and screen.true_picture(9) is None
