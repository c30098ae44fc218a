"""Which pixels of an image move: image averages hardly discriminate where most of the picture stands still."""

from jaxtyping import Bool, Float, Integer
from torch import Tensor


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
