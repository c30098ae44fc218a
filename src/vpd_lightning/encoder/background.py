"""What is static in front of fixed cameras: the training-median image and depth of each camera."""

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor, nn

from vpd_lightning.errors import DataError
from vpd_lightning.types import Cameras, RGBDFrames


class BackgroundModel(nn.Module):
    """Marks pixels that lie in front of the training-median depth of the same camera, or whose colour differs from it.

    Uses no labels, but fixed cameras. Depth tells bodies from their shadows; colour catches what depth misses near
    the floor, so its threshold is high. Both medians live in the state dict.
    """

    # Paper: not in the paper; it gives the inertial dynamics its candidates for motion.

    def __init__(self, *, num_views: int, height: int, width: int, depth_threshold: float, color_threshold: float):
        super().__init__()
        self.depth_threshold, self.color_threshold = depth_threshold, color_threshold
        self.register_buffer("rgb", torch.zeros(num_views, height, width, 3, dtype=torch.uint8))
        self.register_buffer("depth", torch.zeros(num_views, height, width))
        self.register_buffer("cam_to_world", torch.zeros(num_views, 4, 4))
        self.register_buffer("is_fitted", torch.tensor(False))

    def fit(
        self,
        rgb: UInt8[Tensor, "view height width 3"],
        depth: Float[Tensor, "view height width"],
        cameras: Cameras,
    ) -> None:
        """Store the median images (uint8, metres) and the poses of the cameras that took them."""
        if rgb.shape != self.rgb.shape:
            raise DataError(
                f"background images are {tuple(rgb.shape)}, the model expects {tuple(self.rgb.shape)}.\n"
                "Set encoder.background.num_views, height and width to the data's."
            )
        self.rgb.copy_(rgb)
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
        rgb = frames.rgb if frames.rgb.is_floating_point() else frames.rgb.to(frames.depth.dtype) / 255
        difference = (rgb - self.rgb[index].to(rgb.dtype) / 255).abs().amax(dim=-1)
        measured = torch.isfinite(frames.depth) & (frames.depth > 0)
        return (nearer | (difference > self.color_threshold)) & measured

    def _match(self, cameras: Cameras) -> Tensor:
        gap = (cameras.cam_to_world.to(self.cam_to_world.dtype)[..., None, :, :] - self.cam_to_world).abs()
        closest, index = gap.amax(dim=(-2, -1)).min(dim=-1)
        if bool((closest > 1e-3).any()):
            raise DataError(
                "an input camera is not among the fixed cameras of the training set, so its background is unknown.\n"
                "Use the training cameras as input views, or a model without encoder.background."
            )
        return index
