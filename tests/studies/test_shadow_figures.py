"""Shadows that leave and arrive, counted on pixels whose change is known."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from docs.results.studies.shadows import changes, ratios
from tests.evaluation.tossed_box import write_tossed_boxes
from vpd_lightning.data.clip import Clip, read_clip
from vpd_lightning.data.manifest import load_manifest


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Clip:
    """Two predicted frames in which, beside the box, nothing changes but what the tests say."""
    folder = write_tossed_boxes(tmp_path_factory.mktemp("tossed_boxes"))
    found = read_clip(load_manifest(folder).split("test")[0], 0, 0, num_steps=2)
    assert found.state is not None
    segmentation = np.zeros_like(found.state.segmentation)
    last = torch.full_like(found.rgb, 100)
    target = torch.full_like(found.target_rgb, 100)
    target[0, 0, 0, :3] = 60  # a shadow arrives on three pixels
    target[1, 0, 1, :2] = 130  # one leaves two
    target[1, 0, 2, 0] = 119  # too little
    target[:, 0, 5, 5] = 200  # a body at that frame
    target[:, 0, 6, 6] = 200  # and one at the last input frame
    segmentation[found.current_frame + 1 :, 0, 5, 5] = 1
    segmentation[found.current_frame, 0, 6, 6] = 1
    return replace(found, rgb=last, target_rgb=target, state=replace(found.state, segmentation=segmentation))


def test_the_truth_has_all_of_the_change_and_the_last_frame_none(clip: Clip) -> None:
    truth = changes(clip.target_rgb / 255, clip, 20)
    np.testing.assert_allclose(truth, [[-120, -120, 3], [60, 60, 2]], rtol=1e-5)
    copied = changes(clip.rgb[-1:].expand_as(clip.target_rgb) / 255, clip, 20)
    np.testing.assert_allclose(copied, [[0, -120, 3], [0, 60, 2]], atol=1e-3)


def test_half_of_a_change_is_half_and_a_side_without_pixels_has_no_figure(clip: Clip) -> None:
    half = (clip.target_rgb + clip.rgb[-1:].expand_as(clip.target_rgb).float()) / 2 / 255
    sums = changes(half, clip, 20)
    found = ratios(np.stack([sums, sums]))
    for side, levels, pixels in (("arriving", -40, 6), ("leaving", 30, 4)):
        assert found[side]["ratio"] == pytest.approx(0.5, rel=1e-4)
        assert found[side]["ci95"] == pytest.approx([0.5, 0.5], rel=1e-4)
        assert (found[side]["true_levels"], found[side]["pixels"]) == (pytest.approx(levels, rel=1e-4), pixels)
    assert ratios(np.zeros((2, 2, 3)))["leaving"] == {"ratio": None, "ci95": None, "true_levels": None, "pixels": 0}
