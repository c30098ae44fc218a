"""Which pixels count as moving."""

import pytest
import torch

from vpd_lightning.metrics.moving import iou_of_changed_pixels, moving_by_difference, moving_by_segmentation
from vpd_lightning.metrics.true_images import TrueImages


def test_segmentation_marks_where_a_body_is_and_where_it_was() -> None:
    now, before = torch.zeros(4, 6, dtype=torch.uint8), torch.zeros(4, 6, dtype=torch.uint8)
    now[1, 1], before[2, 3] = 1, 2
    assert moving_by_segmentation(now, before).nonzero().tolist() == [[1, 1], [2, 3]]


def test_difference_looks_at_each_channel_alone() -> None:
    before = torch.full((4, 6, 3), 0.5)
    now = before.clone()
    now[0, 0, 1] += 0.11
    now[1, 1] += 0.09
    assert moving_by_difference(now, before, threshold=0.1).nonzero().tolist() == [[0, 0]]


def test_the_shared_part_of_what_changed_in_truth_and_in_the_prediction() -> None:
    last = torch.full((1, 2, 4, 6, 3), 0.5)
    colors = last.repeat(3, 1, 1, 1, 1)
    colors[0, 0, 1, 1:5, 2] = 0.7  # four pixels in one channel
    colors[1, 0, 1, 1:5] = 0.59  # less than the threshold
    colors[2, 0, 0, 0] = 0.0  # fewer than the least number
    pred = last.clone()
    pred[0, 0, 1, 3:6] = 2.0  # two of the four, and one beside them; colours above 1 are cut
    pred[0, 1, 0, 0] = 0.0
    truth = TrueImages(colors, None, 2, last, 0.1)
    found = iou_of_changed_pixels(pred, truth)
    assert found[0, 0] == pytest.approx(2 / 5)
    assert found.isnan().tolist() == [[False, True], [True, True], [True, True]]
    assert (iou_of_changed_pixels(last, truth)[0, 0], iou_of_changed_pixels(colors, truth)[0, 0]) == (0, 1)
