"""One vector for a whole set of particles."""

import torch
from jaxtyping import Float
from torch import Tensor

from vpd_lightning.types import Particles


def mean_features(particles: Particles) -> Float[Tensor, "*batch feature"]:
    """Return the mean feature of the particles that are there; zeros where there are none.

    Of a scene that one particle carries, this is exactly that particle's feature.
    """
    total = torch.where(particles.mask[..., None], particles.features, 0.0).sum(dim=-2)
    return total / particles.mask.sum(dim=-1, keepdim=True).clamp(min=1)
