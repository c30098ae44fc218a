"""What edits do to the pixels that particles are of: what was moved by hand is followed in no picture."""

from dataclasses import replace

import pytest
import torch

import vpd_lightning as vpd
from tests.editing.scenes import BLUE, RED, two_boxes
from vpd_lightning.editing.selectors import Box
from vpd_lightning.simulator import Scene
from vpd_lightning.types import Cameras, Pictures

AROUND_RED = Box([-1.2, -0.3, 0.3], [-0.4, 0.7, 1.1])


def pictured_scene(seed=0):
    """Two boxes above a floor, whose particles are pixels of a picture; and the body of each current particle."""
    scene, _, now = two_boxes(seed)
    camera = Cameras(torch.eye(3)[None, None], torch.eye(4)[None, None], 30, 30)
    pictures = Pictures(torch.rand(1, 1, 30, 30, 3), torch.ones(1, 1, 30, 30), camera)

    def pictured(frame):
        return replace(frame, pixels=torch.arange(frame.num_particles)[None], pictures=pictures)

    return Scene(pictured(scene.previous), pictured(scene.current)), now


@pytest.mark.parametrize("edit", ["move", "scale", "set_velocity"])
def test_only_what_is_edited_is_no_longer_a_pixel(edit):
    scene, now = pictured_scene()
    arguments = {"move": {"translation": [0.1, 0.0, 0.0]}, "scale": {"factor": 1.2}, "set_velocity": {}}[edit]

    edited = getattr(vpd.SceneEditor(scene), edit)(AROUND_RED, **arguments).scene.current

    assert (edited.pixels[0][now == RED] == -1).all()
    assert torch.equal(edited.pixels[0][now != RED], scene.current.pixels[0][now != RED])
    assert edited.pictures is scene.current.pictures


def test_copies_and_inserted_bodies_are_no_pixels():
    scene, now = pictured_scene()
    other, _ = pictured_scene(1)
    plain, _, _ = two_boxes(2)
    count = scene.current.num_particles

    for editor in (
        vpd.SceneEditor(scene).duplicate(AROUND_RED, [0.0, 1.0, 0.0]),
        vpd.SceneEditor(scene).insert(other, AROUND_RED, [0.0, 1.0, 0.0]),
        vpd.SceneEditor(scene).insert(plain, AROUND_RED, [0.0, 1.0, 0.0]),
    ):
        edited = editor.scene.current
        assert torch.equal(edited.pixels[:, :count], scene.current.pixels) and edited.num_particles > count
        assert (edited.pixels[:, count:] == -1).all()


def test_scenes_without_pictures_are_edited_as_before():
    scene, _, now = two_boxes()
    edited = vpd.SceneEditor(scene).move(AROUND_RED, [0.1, 0.0, 0.0]).scene.current
    assert edited.pixels is None and edited.pictures is None and (now == BLUE).any()
