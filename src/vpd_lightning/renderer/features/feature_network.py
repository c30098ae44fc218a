"""A network like PointNeRF's that maps a particle's feature and relative location to the feature of a sample."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from vpd_lightning.renderer.field.positional_encoding import encoding_dim, positional_encoding
from vpd_lightning.renderer.field.precision import at_least_float32, full_precision


class FeatureNetwork(nn.Module):
    """``F(z, (x - p) / s)``: from a latent feature and a scaled offset to a feature of the same width.

    The paper (appendix "Feature Encoding Experiments") takes it from PointNeRF (Xu et al. 2022), and does not mention
    its size. The offset is encoded by ``offset_degree`` frequencies; hidden layers have ReLU, the last one nothing
    behind it. At 16 features, width 64, two hidden layers and degree 5: (16 + 33) * 64 + 64, 64 * 64 + 64 and
    64 * 16 + 16, 8,400 parameters in all.

    With ``is_inverse_distance`` the sum over neighbours weighs them by the share of their inverse distance, as
    PointNeRF does, on top of the kernels.
    """

    def __init__(
        self, *, feature_dim: int, width: int, num_hidden_layers: int, offset_degree: int, is_inverse_distance: bool
    ) -> None:
        super().__init__()
        sizes = {"feature_dim": feature_dim, "width": width, "num_hidden_layers": num_hidden_layers}
        for name, value in sizes.items():
            if value < 1:
                raise ValueError(f"{name} must be at least 1, got {value}.")
        if offset_degree < 0:
            raise ValueError(f"offset_degree must be at least 0, got {offset_degree}.")
        self.feature_dim = feature_dim
        self.offset_degree = offset_degree
        self.is_inverse_distance = is_inverse_distance
        widths = [feature_dim + encoding_dim(offset_degree), *[width] * num_hidden_layers]
        layers: list[nn.Module] = []
        for before, after in zip(widths[:-1], widths[1:], strict=True):
            layers += [nn.Linear(before, after), nn.ReLU()]
        self.layers = nn.Sequential(*layers, nn.Linear(widths[-1], feature_dim))

    def forward(
        self, latents: Float[Tensor, "*rows feature"], offsets: Float[Tensor, "*rows 3"]
    ) -> Float[Tensor, "*rows feature"]:
        """Return the feature at each ``offset`` (in units of the largest kernel radius), in at least float32."""
        with full_precision(offsets):
            encoded = positional_encoding(at_least_float32(offsets), self.offset_degree)
        result: Tensor = self.layers(torch.cat([latents.to(encoded.dtype), encoded], dim=-1))
        return at_least_float32(result)
