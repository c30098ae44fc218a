"""One latent vector per scene from RGB images and their cameras: RGBDFrames -> a single particle (Li et al. 2021)."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from vpd_lightning.encoder.base import AbstractEncoder, EncoderOutput
from vpd_lightning.encoder.networks.resnet import ResNetTrunk
from vpd_lightning.errors import DataError
from vpd_lightning.finite import require_finite
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.types import Particles, RGBDFrames


class GlobalSceneEncoder(AbstractEncoder):
    """The image encoder of NeRF-dy (Li et al. 2021, "3D Neural Scene Representations for Visuomotor Control").

    Each view: ResNet map before pooling, one linear layer to ``hidden_dim``, joined by the 16 numbers of the
    world-to-camera matrix, a small network. Then the mean over views, another small network, and unit length. The
    scene vector is the feature of one particle at the origin; depth is never looked at.

    ``height`` and ``width`` (pixels) are those of the images: the linear layer has weights for each place of the map.
    Translations are divided by half the longest side of the workspace box, so that they are of the size of rotations.
    """

    # Paper: says that the baseline encodes images and camera orientation into one vector as NeRF-dy does, and gives no
    # sizes. Those of the two small networks (one hidden layer) and of the vector are ours; so are group normalisation,
    # the scale of translations, and that each context frame is encoded on its own.

    def __init__(
        self,
        *,
        feature_dim: int,
        hidden_dim: int,
        widths: Sequence[int],
        blocks: Sequence[int],
        num_groups: int | None,
        height: int,
        width: int,
        workspace_min: Sequence[float],
        workspace_max: Sequence[float],
    ):
        super().__init__()
        sizes = {"feature_dim": feature_dim, "hidden_dim": hidden_dim, "height": height, "width": width}
        for name, value in sizes.items():
            if value < 1:
                raise ValueError(f"{name} must be at least 1, got {value}")
        sides = [high - low for low, high in zip(workspace_min, workspace_max, strict=True)]
        if min(sides) <= 0:
            raise ValueError(f"workspace_min {list(workspace_min)} must lie below workspace_max {list(workspace_max)}")
        self.background = None
        self.feature_dim = feature_dim
        self.height, self.width = height, width
        self.length_unit = max(sides) / 2
        self.trunk = ResNetTrunk(in_channels=3, widths=widths, blocks=blocks, num_groups=num_groups)
        rows, columns = self.trunk.map_size(height, width)
        self.image_head = nn.Linear(self.trunk.out_channels * rows * columns, hidden_dim)
        self.view_network = nn.Sequential(
            nn.Linear(hidden_dim + 16, hidden_dim), nn.ReLU(), nn.Linear(hidden_dim, hidden_dim)
        )
        self.state_network = nn.Sequential(
            nn.Linear(hidden_dim, hidden_dim), nn.ReLU(), nn.Linear(hidden_dim, feature_dim)
        )
        for module in (self.image_head, *self.view_network, *self.state_network):
            if isinstance(module, nn.Linear):  # He et al. 2015: keeps the variance of activations
                nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
                nn.init.zeros_(module.bias)

    def forward(self, frames: RGBDFrames, keys: RandomKeys, purpose: str) -> EncoderOutput:
        """Encode the frames of one time step (axes ``batch view``, any number of views in any order).

        Raises:
            DataError: images of another size than the encoder was built for.
        """
        cam_to_world = frames.cameras.cam_to_world
        rgb = frames.rgb if frames.rgb.is_floating_point() else frames.rgb.to(cam_to_world.dtype) / 255
        height, width = rgb.shape[-3:-1]
        if (height, width) != (self.height, self.width):
            raise DataError(
                f"the images are {height}x{width}, but the encoder is built for {self.height}x{self.width}.\n"
                f"Set encoder.height={height} encoder.width={width} and train again; the weights depend on it."
            )
        require_finite("Encoder", rgb=rgb, cameras=cam_to_world)
        maps = self.trunk((2 * rgb - 1).flatten(0, 1).movedim(-1, 1))
        seen = self.image_head(maps.flatten(1)).unflatten(0, rgb.shape[:2])
        views = self.view_network(torch.cat([seen, self._view_matrices(cam_to_world).to(seen.dtype)], dim=-1))
        state = self.state_network(views.mean(dim=1)).to(cam_to_world.dtype)
        features = nn.functional.normalize(state, dim=-1)[:, None]
        particles = Particles(positions=features.new_zeros(len(features), 1, 3), features=features)
        return EncoderOutput(particles)

    def _view_matrices(self, cam_to_world: Float[Tensor, "*camera 4 4"]) -> Float[Tensor, "*camera 16"]:
        """Return the flattened world-to-camera matrices, row by row, with scaled translations."""
        rotation = cam_to_world[..., :3, :3].mT
        # Explicit sums: autocast may not lower the precision of geometry.
        translation = -(rotation * cam_to_world[..., None, :3, 3]).sum(dim=-1) / self.length_unit
        top = torch.cat([rotation, translation[..., None]], dim=-1)
        return torch.cat([top, cam_to_world[..., 3:, :]], dim=-2).flatten(-2)
