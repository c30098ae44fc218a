"""UNet features at unprojected pixels, cropped to the workspace and subsampled: RGBDFrames -> Particles (paper 3.1)."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from vpd_lightning.encoder.background import BackgroundModel
from vpd_lightning.encoder.base import AbstractEncoder, EncoderOutput
from vpd_lightning.encoder.unet_network import UNetNetwork
from vpd_lightning.errors import EmptyWorkspaceError
from vpd_lightning.geometry.cameras import unproject
from vpd_lightning.geometry.normals import depth_normals
from vpd_lightning.geometry.workspace import choose, inside_workspace
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.types import Particles, RGBDFrames, require_finite

# Share of pixels below which the last convolution is gathered at the chosen ones (measured on a CPU): at 8 % of the
# pixels that is four times faster than convolving all of them, at 100 % ten times slower. Same numbers either way.
_GATHER_BELOW = 0.1


class UNetEncoder(AbstractEncoder):
    """Each pixel inside the workspace becomes a particle (position by depth, features by the UNet of the RGB image).

    The UNet sees RGB only and shares its weights over cameras. ``num_particles`` are chosen uniformly at random. With
    ``moving_fraction`` (and a ``background`` model) that share of them is chosen among pixels that may be moving.
    """

    # Paper: moving_fraction, background and use_normals are ours; None, None, False is the paper.

    def __init__(
        self,
        *,
        channels: Sequence[int],
        num_particles: int,
        workspace_min: Sequence[float],
        workspace_max: Sequence[float],
        moving_fraction: float | None,
        background: BackgroundModel | None,
        use_normals: bool,
    ):
        super().__init__()
        if num_particles < 1:
            raise ValueError(f"num_particles must be at least 1, got {num_particles}")
        if any(low >= high for low, high in zip(workspace_min, workspace_max, strict=True)):
            raise ValueError(f"workspace_min {list(workspace_min)} must lie below workspace_max {list(workspace_max)}")
        if moving_fraction is not None and background is None:
            raise ValueError("moving_fraction needs a background model; set encoder.background or moving_fraction=null")
        if moving_fraction is not None and not 0 < moving_fraction < 1:
            raise ValueError(f"moving_fraction must lie between 0 and 1, got {moving_fraction}")
        self.network = UNetNetwork(channels=channels, in_channels=3)
        self.feature_dim = channels[-1]
        self.num_particles = num_particles
        self.workspace_min, self.workspace_max = list(workspace_min), list(workspace_max)
        self.moving_fraction = moving_fraction
        self.background = background
        self.use_normals = use_normals

    def pixel_features(self, rgb: Float[Tensor, "*shape height width 3"]) -> Tensor:
        """Return features of every pixel, axes ``... height width feature``; softplus keeps them positive."""
        features = self.network(rgb.flatten(0, -4).movedim(-1, 1)).movedim(1, -1)
        return self._activate(features, rgb.dtype).reshape(*rgb.shape[:-1], self.feature_dim)

    def _features_at(self, rgb: Float[Tensor, "batch view height width 3"], index: Tensor) -> Tensor:
        """Return the features of the chosen pixels; ``index`` counts over ``view height width`` of each member."""
        pixels_per_member = rgb[0, ..., 0].numel()
        if index.shape[1] > _GATHER_BELOW * pixels_per_member:
            every = self.pixel_features(rgb).flatten(1, 3)
            return torch.gather(every, 1, index[..., None].expand(-1, -1, self.feature_dim))
        member = torch.arange(len(rgb), device=index.device)[:, None]
        pixels = (member * pixels_per_member + index).flatten()
        features = self.network.at_pixels(rgb.flatten(0, 1).movedim(-1, 1), pixels)
        return self._activate(features, rgb.dtype).reshape(*index.shape, self.feature_dim)

    @staticmethod
    def _activate(features: Tensor, dtype: torch.dtype) -> Tensor:
        # Kernel sums and positions downstream stay in full precision, whatever autocast did to the convolutions.
        return torch.nn.functional.softplus(features.to(dtype))

    def forward(self, frames: RGBDFrames, keys: RandomKeys, purpose: str) -> EncoderOutput:
        """Encode the frames of one time step (axes ``batch view``).

        Raises:
            EmptyWorkspaceError: no measured pixel of a batch member lies in the workspace.
        """
        rgb = frames.rgb if frames.rgb.is_floating_point() else frames.rgb.to(frames.depth.dtype) / 255
        cameras = frames.cameras
        require_finite(
            "Encoder", rgb=rgb, cameras=torch.cat([cameras.intrinsics.flatten(), cameras.cam_to_world.flatten()])
        )
        points = unproject(frames.depth, frames.cameras).flatten(1, 3)
        measured = (torch.isfinite(frames.depth) & (frames.depth > 0)).flatten(1)
        candidates = measured & inside_workspace(points, self.workspace_min, self.workspace_max)
        moving = None
        if self.background is not None:
            moving, border = (pixels.flatten(1) for pixels in _with_border(self.background(frames)))
            candidates = candidates & ~border
        index, valid = self._choose(candidates, moving, keys, purpose)

        points = torch.where(candidates[..., None], points, torch.zeros_like(points))  # no NaN through padding

        def take(values: Tensor) -> Tensor:
            return torch.gather(values, 1, index[..., None].expand(-1, -1, values.shape[-1]))

        particles = Particles(
            positions=take(points) * valid[..., None],
            features=self._features_at(rgb, index) * valid[..., None],
            mask=valid,
            colors=take(rgb.flatten(1, 3)),
            moving=None if moving is None else torch.gather(moving, 1, index) & valid,
            normals=take(depth_normals(frames.depth, frames.cameras).flatten(1, 3)) if self.use_normals else None,
        )
        return EncoderOutput(particles)

    def _choose(
        self, candidates: Bool[Tensor, "batch point"], moving: Tensor | None, keys: RandomKeys, purpose: str
    ) -> tuple[Tensor, Tensor]:
        indices, valids = [], []
        for member, generator in enumerate(keys.generators(f"particles/{purpose}")):
            allowed = candidates[member]
            if not bool(allowed.any()):
                low, high = self.workspace_min, self.workspace_max
                raise EmptyWorkspaceError(
                    f"no measured pixel of batch member {member} lies in the workspace {low} to {high}.\n"
                    "Check depth (metres), camera poses (camera to world, OpenCV axes) and scene.workspace_min/max."
                )
            if self.moving_fraction is None or moving is None:
                index, valid = choose(allowed, self.num_particles, generator)
            else:
                num_moving = round(self.moving_fraction * self.num_particles)
                moving_index, moving_valid = choose(allowed & moving[member], num_moving, generator)
                index, valid = choose(allowed & ~moving[member], self.num_particles - num_moving, generator)
                index, valid = torch.cat([moving_index, index]), torch.cat([moving_valid, valid])
            indices.append(index)
            valids.append(valid)
        return torch.stack(indices), torch.stack(valids)


def _with_border(moving: Bool[Tensor, "batch view height width"]) -> tuple[Tensor, Tensor]:
    """Return the moving pixels and those beside them that are not.

    At a body's foot its depth hardly differs from what stands behind: such a pixel is neither surely moving nor surely
    static, and with a normal between the two it would be a false wall. It becomes no particle.
    """
    grown = torch.nn.functional.max_pool2d(moving.float(), 3, stride=1, padding=1) > 0
    return moving, grown & ~moving
