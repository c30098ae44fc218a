"""Stage 5b: numbers that judge images, point sets and motion. Pure functions, no gradients needed."""

from vpd_lightning.metrics.chamfer import ChamferDistance, chamfer
from vpd_lightning.metrics.psnr import masked_psnr, psnr
from vpd_lightning.metrics.sharpness import sharpness
from vpd_lightning.metrics.ssim import ssim

__all__ = ["ChamferDistance", "chamfer", "masked_psnr", "psnr", "sharpness", "ssim"]
