"""Which pixels count as moving."""

import torch

from vpd_lightning.metrics.moving import moving_by_difference, moving_by_segmentation


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
