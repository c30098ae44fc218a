"""Which pixels of an image move: image averages hardly discriminate where most of the picture stands still."""

import torch
from jaxtyping import Bool, Float, Integer
from torch import Tensor

from vpd_lightning.metrics.true_images import TrueImages


def moving_by_segmentation(
    segmentation: Integer[Tensor, "*image height width"], last_input: Integer[Tensor, "*image height width"]
) -> Bool[Tensor, "*image height width"]:
    """Pixels of a moving body at that frame or at the last input frame (where it must have disappeared).

    Segmentations are 0 for the static scene and positive for moving bodies.
    """
    return (segmentation > 0) | (last_input > 0)


def moving_by_difference(
    rgb: Float[Tensor, "*image height width 3"], last_input: Float[Tensor, "*image height width 3"], threshold: float
) -> Bool[Tensor, "*image height width"]:
    """Pixels whose true colour (in [0, 1]) differs from the last input frame by more than ``threshold`` in a channel.

    For recordings without segmentation. It leaves out those pixels of a moving body that keep their colour.
    """
    return ((rgb - last_input).abs() > threshold).any(-1)


def iou_of_changed_pixels(
    pred: Float[Tensor, "step_or_1 view height width 3"], truth: TrueImages
) -> Float[Tensor, "step view"]:
    """Intersection over union of the pixels that changed since the last input frame, as predicted and in truth.

    It says whether bodies and their shadows are where they should be and have left where they were. What stands still
    and is drawn wrongly by more than the threshold counts as changed. NaN for an image in which fewer than
    ``truth.min_moving_pixels`` pixels truly changed, and where the camera moves: all of the picture changes there.
    """
    if truth.last_input is None:  # the camera moves
        return truth.colors.new_full(truth.colors.shape[:2], torch.nan)
    last, threshold = truth.last_input.expand_as(truth.colors), truth.moving_threshold
    true = moving_by_difference(truth.colors, last, threshold)
    found = moving_by_difference(pred.clamp(0, 1).expand_as(last), last, threshold)
    shared, either = ((true & found).sum((-2, -1)), (true | found).sum((-2, -1)))
    ratio = shared.to(truth.colors.dtype) / either.clamp(min=1)
    return torch.where(true.sum((-2, -1)) >= truth.min_moving_pixels, ratio, torch.nan)
