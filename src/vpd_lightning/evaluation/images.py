"""Image metrics of one clip, for the model and for the references alike; every value keeps its view and step."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vpd_lightning.data.clip import Clip
from vpd_lightning.evaluation.protocol import Protocol
from vpd_lightning.metrics.moving import moving_by_difference, moving_by_segmentation
from vpd_lightning.metrics.psnr import PSNR_CAP, mean_squared_error, psnr_of
from vpd_lightning.metrics.sharpness import sharpness
from vpd_lightning.metrics.ssim import KERNEL_SIZE, LocalMoments, local_moments, ssim_of


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


@dataclass(frozen=True)
class TrueImages:
    """The truth that predictions are compared with, and what is known of it already.

    Images with fewer than ``min_moving_pixels`` moving ones have no values on moving pixels.
    """

    colors: Float[Tensor, "step view height width 3"]
    moving: Bool[Tensor, "step view height width"]
    moments: LocalMoments | None
    min_moving_pixels: int

    @classmethod
    def of(
        cls,
        colors: Float[Tensor, "step view height width 3"],
        moving: Bool[Tensor, "step view height width"],
        min_moving_pixels: int,
    ) -> "TrueImages":
        """Prepare true images (colours in [0, 1]) for comparison; those smaller than SSIM's window have no SSIM."""
        has_ssim = min(colors.shape[-3:-1]) >= KERNEL_SIZE
        return cls(colors, moving, local_moments(colors) if has_ssim else None, min_moving_pixels)


def image_metrics(
    pred: Float[Tensor, "step_or_1 view height width 3"], target: TrueImages
) -> dict[str, Float[Tensor, "view step"]]:
    """Squared error, PSNR, SSIM and sharpness of every image, and the first two on moving pixels too (NaN: too few).

    A prediction of one step stands for all steps. PSNR is cut at ``PSNR_CAP`` dB, so that one exact image (a scene at
    rest, copied) does not make a mean infinite.
    """
    everywhere = pred.expand_as(target.colors)
    mse = mean_squared_error(everywhere, target.colors)
    moving_mse = mean_squared_error(everywhere, target.colors, target.moving)
    enough = target.moving.sum((-2, -1)) >= target.min_moving_pixels
    moving_mse = torch.where(enough, moving_mse, torch.full_like(moving_mse, torch.nan))
    similarity = torch.full_like(mse, torch.nan)
    if target.moments is not None:
        similarity = ssim_of(local_moments(pred.clamp(0.0, 1.0)), target.moments)
    values = {
        "mse": mse,
        "psnr": psnr_of(mse).clamp(max=PSNR_CAP),
        "ssim": similarity,
        "moving_mse": moving_mse,
        "psnr_moving": psnr_of(moving_mse).clamp(max=PSNR_CAP),
        "sharpness": sharpness(pred, target.colors),
    }
    return {name: value.T.contiguous() for name, value in values.items()}
