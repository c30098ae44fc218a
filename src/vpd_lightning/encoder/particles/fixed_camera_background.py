"""What stands still in front of fixed cameras: the training-median depth of each camera."""

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from vpd_lightning.encoder.base import AbstractBackground
from vpd_lightning.errors import DataError
from vpd_lightning.types import Cameras, RGBDFrames


class BackgroundModel(AbstractBackground):
    """Marks pixels that lie nearer than the training-median depth of the same camera.

    Uses no labels, but fixed cameras. Depth, unlike colour, separates bodies from their shadows. The median images
    live in the state dict.
    """

    # Paper: not in the paper; it gives the inertial dynamics its candidates for motion.

    needs_fit = True

    def __init__(self, *, num_views: int, height: int, width: int, depth_threshold: float):
        super().__init__()
        if depth_threshold <= 0:
            raise ValueError(f"depth_threshold must be positive, got {depth_threshold}")
        self.depth_threshold = depth_threshold
        self.register_buffer("depth", torch.zeros(num_views, height, width))
        self.register_buffer("cam_to_world", torch.zeros(num_views, 4, 4))
        self.register_buffer("is_fitted", torch.tensor(False))

    def fit(
        self,
        rgb: UInt8[Tensor, "view height width 3"],
        depth: Float[Tensor, "view height width"],
        cameras: Cameras,
    ) -> None:
        """Store the median depth (metres) and the poses of the cameras that took it; colours are not used."""
        if depth.shape != self.depth.shape:
            raise DataError(
                f"background images are {tuple(depth.shape)}, the model expects {tuple(self.depth.shape)}.\n"
                "Set encoder.background.num_views, height and width to the data's."
            )
        self.depth.copy_(torch.nan_to_num(depth, nan=0.0, posinf=0.0, neginf=0.0))
        self.cam_to_world.copy_(cameras.cam_to_world)
        self.is_fitted.fill_(True)

    def forward(self, frames: RGBDFrames) -> Bool[Tensor, "batch view height width"]:
        """Return which pixels may be moving.

        Raises:
            DataError: not fitted, or a camera that was not among the training cameras.
        """
        if not bool(self.is_fitted):
            raise DataError("the background model has not been fitted; call encoder.background.fit(...) first.")
        index = self._match(frames.cameras)
        background_depth = self.depth[index]
        nearer = (background_depth - frames.depth > self.depth_threshold) | (background_depth <= 0)
        return nearer & torch.isfinite(frames.depth) & (frames.depth > 0)

    def _match(self, cameras: Cameras) -> Tensor:
        gap = (cameras.cam_to_world.to(self.cam_to_world.dtype)[..., None, :, :] - self.cam_to_world).abs()
        closest, index = gap.amax(dim=(-2, -1)).min(dim=-1)
        if bool((closest > 1e-3).any()):
            raise DataError(
                "an input camera is not among the fixed cameras of the training set, so its background is unknown.\n"
                "Use the training cameras as input views, or a model without encoder.background."
            )
        return index
