"""Image metrics of one clip, for the model and for the references alike; every value keeps its view and step."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vpd_lightning.evaluation.protocol import Clip, Protocol
from vpd_lightning.metrics.moving import moving_by_difference, moving_by_segmentation
from vpd_lightning.metrics.psnr import PSNR_CAP, mean_squared_error, psnr_of
from vpd_lightning.metrics.ssim import ssim


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


def image_metrics(
    pred: Float[Tensor, "step view height width 3"],
    target: Float[Tensor, "step view height width 3"],
    moving: Bool[Tensor, "step view height width"],
    min_pixels: int,
) -> dict[str, Float[Tensor, "view step"]]:
    """Squared error, PSNR and SSIM of every image, and the first two on moving pixels (NaN where too few move).

    PSNR is cut at ``PSNR_CAP`` dB, so that one exact image (a scene at rest, copied) does not make a mean infinite.
    """
    mse = mean_squared_error(pred, target)
    moving_mse = mean_squared_error(pred, target, moving)
    moving_mse = torch.where(moving.sum((-2, -1)) >= min_pixels, moving_mse, torch.full_like(moving_mse, torch.nan))
    values = {
        "mse": mse,
        "psnr": psnr_of(mse).clamp(max=PSNR_CAP),
        "ssim": ssim(pred, target),
        "moving_mse": moving_mse,
        "psnr_moving": psnr_of(moving_mse).clamp(max=PSNR_CAP),
    }
    return {name: value.T.contiguous() for name, value in values.items()}
