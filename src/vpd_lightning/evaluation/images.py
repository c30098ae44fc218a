"""The true images of a clip, as metrics read them."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vpd_lightning.data.clip import Clip
from vpd_lightning.evaluation.protocol import Protocol
from vpd_lightning.metrics.moving import moving_by_difference, moving_by_segmentation


def as_float(rgb: Tensor) -> Float[Tensor, "*image height width 3"]:
    """Turn uint8 colours into float32 in [0, 1]."""
    return rgb.to(torch.float32) / 255.0


def moving_pixels(clip: Clip, protocol: Protocol) -> Bool[Tensor, "step view height width"]:
    """Pixels that count as moving, by segmentation where the recording has it, else by the change of colour."""
    if clip.state is not None:
        segmentation = torch.from_numpy(clip.state.segmentation)
        later = segmentation[clip.current_frame + 1 : clip.current_frame + 1 + clip.target_rgb.shape[0]]
        return moving_by_segmentation(later, segmentation[clip.current_frame].expand_as(later))
    target = as_float(clip.target_rgb)
    return moving_by_difference(target, as_float(clip.rgb[-1]).expand_as(target), protocol.moving_threshold)
