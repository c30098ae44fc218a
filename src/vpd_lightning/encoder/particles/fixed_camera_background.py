"""What stands still in front of fixed cameras: the training-median depth of each camera."""

from typing import Any

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from vpd_lightning.encoder.base import AbstractBackground
from vpd_lightning.errors import DataError
from vpd_lightning.types import Cameras, RGBDFrames


class BackgroundModel(AbstractBackground):
    """Marks pixels that lie nearer than the training-median depth of the same camera.

    Uses no labels, but fixed cameras. Depth, unlike colour, separates bodies from their shadows. The median images
    live in the state dict; ``num_views``, ``height`` and ``width`` say their shape, null takes that of what is fitted
    or loaded.
    """

    # Paper: not in the paper; it gives the inertial dynamics its candidates for motion.

    needs_fit = True
    depth: Tensor
    cam_to_world: Tensor

    def __init__(self, *, num_views: int | None, height: int | None, width: int | None, depth_threshold: float):
        super().__init__()
        if depth_threshold <= 0:
            raise ValueError(f"depth_threshold must be positive, got {depth_threshold}")
        self.depth_threshold = depth_threshold
        self.shape = (num_views, height, width)
        self.register_buffer("depth", torch.zeros(num_views or 0, height or 0, width or 0))
        self.register_buffer("cam_to_world", torch.zeros(num_views or 0, 4, 4))
        self.register_buffer("is_fitted", torch.tensor(False))
        self.register_load_state_dict_pre_hook(_shaped_as_loaded)

    def fit(
        self,
        rgb: UInt8[Tensor, "view height width 3"],
        depth: Float[Tensor, "view height width"],
        cameras: Cameras,
    ) -> None:
        """Store the median depth (metres) and the poses of the cameras that took it; colours are not used."""
        if any(size not in (None, found) for size, found in zip(self.shape, depth.shape, strict=True)):
            raise DataError(
                f"background images are {tuple(depth.shape)}, the model expects {self.shape}.\n"
                "Set encoder.background.num_views, height and width to the data's."
            )
        self.depth = torch.nan_to_num(depth, nan=0.0, posinf=0.0, neginf=0.0).to(self.depth)
        self.cam_to_world = cameras.cam_to_world.to(self.cam_to_world)
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


def _shaped_as_loaded(module: BackgroundModel, state: dict[str, Tensor], prefix: str, *rest: Any) -> None:
    """Take the shape of images that are loaded, where none was set."""
    if None not in module.shape:
        return
    for name in ("depth", "cam_to_world"):
        if prefix + name in state:
            setattr(module, name, getattr(module, name).new_zeros(state[prefix + name].shape))
