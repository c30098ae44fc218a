"""FLIP: how different two images look when one alternates between them (Andersson et al. 2020), one value per image."""

from importlib.util import find_spec

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from vpd_lightning.metrics.true_images import TrueImages

VIEWING_CONDITIONS = (0.7, 3840.0, 0.7)
"""Distance to the screen (m), and its width in pixels and in metres: 67 pixels per degree, what the package assumes."""


def is_installed() -> bool:
    """Whether the package ``flip-evaluator`` is there; it has no wheel for some processors (pyproject.toml)."""
    return find_spec("flip_evaluator") is not None


def flip(
    pred: Float[Tensor, "*image height width 3"], target: Float[Tensor, "*image height width 3"]
) -> Float[Tensor, "*image"]:
    """LDR-FLIP of sRGB images in [0, 1], one value per image, 0 (identical) to 1; the prediction is clamped.

    The mean over pixels of the error map of NVIDIA's ``flip-evaluator`` for ``VIEWING_CONDITIONS``, on as many CPU
    threads as PyTorch uses. It does not matter which image is which.

    Raises:
        ModuleNotFoundError: the package is not installed.
    """
    from flip_evaluator import evaluate
    from threadpoolctl import threadpool_limits

    size = target.shape[-3:]
    tests, references = (
        images.detach().reshape(-1, *size).float().cpu().numpy() for images in (pred.clamp(0, 1), target)
    )
    # The package brings OpenMP threads of its own, as many as there are cores.
    with threadpool_limits(limits=torch.get_num_threads(), user_api="openmp"):
        means = [
            evaluate(
                reference, test, "LDR", applyMagma=False, computeMeanError=False,
                parameters={"vc": list(VIEWING_CONDITIONS)},
            )[0].mean(dtype=np.float64)
            for reference, test in zip(references, tests, strict=True)
        ]  # fmt: skip
    return target.new_tensor(means).reshape(target.shape[:-3])


def flip_of_images(
    pred: Float[Tensor, "step_or_1 view height width 3"], truth: TrueImages
) -> Float[Tensor, "step view"]:
    """FLIP of every image; NaN where the package is not installed."""
    if not is_installed():
        return truth.colors.new_full(truth.colors.shape[:2], torch.nan)
    return flip(pred.expand_as(truth.colors), truth.colors)
