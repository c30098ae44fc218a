"""What each body is made of, inferred from its particles' features: how it slides, bounces, weighs and deforms."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from vpd_lightning.dynamics.inertial.body_motion import BodyMotion

_GAIN = 4.0
"""Softness spans orders of magnitude and begins at its small end; a rate that suits the others would be too slow."""


_FIRST_FRICTION = 0.5


@dataclass(frozen=True)
class Materials:
    """What a body is made of.

    Coulomb ``friction``; ``restitution`` (share of the normal speed kept in an impact, 0 to 1);
    ``density`` relative to other bodies; ``softness`` (0 to 1: how much a push stretches); ``stiffness`` (the squared
    angular frequency of its elastic return, per step squared, below 1); ``damping`` of it (share per step, 0 to 1).
    """

    friction: Float[Tensor, "batch body 1"]
    restitution: Float[Tensor, "batch body 1"]
    density: Float[Tensor, "batch body 1"]
    softness: Float[Tensor, "batch body 1"]
    stiffness: Float[Tensor, "batch body 1"]
    damping: Float[Tensor, "batch body 1"]


class MaterialNetwork(nn.Module):
    """A small network on the mean features of a body; before training all bodies are alike, and nearly rigid.

    The same numbers are inferred for the same features, so one model holds rigid and soft bodies. Where bodies slide on
    a table their deceleration shows the product of friction and weight alone; with ``max_friction`` a large friction
    cannot stand for a weight that is not learned yet (null: at most 7.4).

    Raises:
        ValueError: ``max_friction`` is not more than the 0.5 that training starts from.
    """

    def __init__(self, *, feature_dim: int, hidden_dim: int, is_soft: bool, max_friction: float | None):
        super().__init__()
        if max_friction is not None and max_friction <= _FIRST_FRICTION:
            raise ValueError(f"max_friction must be more than {_FIRST_FRICTION} or null, got {max_friction}")
        self.is_soft, self.max_friction = is_soft, max_friction
        self.network = nn.Sequential(
            nn.LayerNorm(feature_dim), nn.Linear(feature_dim, hidden_dim), nn.SiLU(), nn.Linear(hidden_dim, 6)
        )
        last = self.network[-1]
        assert isinstance(last, nn.Linear)
        nn.init.zeros_(last.weight)
        with torch.no_grad():
            # restitution 0.1, density 1, softness 0.01, stiffness 0.25, damping 0.1
            first = math.log(_FIRST_FRICTION) if max_friction is None else _logit(_FIRST_FRICTION / max_friction)
            start = [first, _logit(0.1), 0.0, _logit(0.01) / _GAIN, _logit(0.25), _logit(0.1)]
            last.bias.copy_(torch.tensor(start))

    def forward(
        self, features: Float[Tensor, "batch particle feature"], weights: Float[Tensor, "batch body particle"]
    ) -> Materials:
        """Return the materials; ``weights`` sum to one over the particles of a body."""
        mean = torch.einsum("bkp,bpf->bkf", weights, features)
        friction, restitution, density, softness, stiffness, damping = self.network(mean).split(1, dim=-1)
        softness = torch.sigmoid(_GAIN * softness) if self.is_soft else torch.zeros_like(softness)
        bounded = torch.exp(friction.clamp(-5, 2))
        if self.max_friction is not None:
            bounded = self.max_friction * torch.sigmoid(friction)
        return Materials(
            friction=bounded,
            restitution=torch.sigmoid(restitution),
            density=torch.exp(density.clamp(-3, 3)),
            softness=softness,
            stiffness=torch.sigmoid(stiffness),
            damping=torch.sigmoid(damping),
        )


_FIRST_GUIDED = 0.05
_GUIDED_GAIN = 8.0
"""A hand holds a body altogether or not at all: with 0.97 of that, three per cent of gravity sink it."""


class GuidanceNetwork(nn.Module):
    """How much of a body's motion goes on whatever acts on it, inferred from its features: 0 to 1.

    A hand or a robot moves it, which no force between bodies explains: it goes on as it came, does not fall, and what
    it meets gives way. Before training that is 0.05 for all bodies.
    """

    def __init__(self, *, feature_dim: int, hidden_dim: int):
        super().__init__()
        self.network = nn.Sequential(
            nn.LayerNorm(feature_dim), nn.Linear(feature_dim, hidden_dim), nn.SiLU(), nn.Linear(hidden_dim, 1)
        )
        last = self.network[-1]
        assert isinstance(last, nn.Linear)
        nn.init.zeros_(last.weight)
        nn.init.constant_(last.bias, _logit(_FIRST_GUIDED) / _GUIDED_GAIN)

    def forward(
        self, features: Float[Tensor, "batch particle feature"], weights: Float[Tensor, "batch body particle"]
    ) -> Float[Tensor, "batch body 1"]:
        """Return the shares; ``weights`` sum to one over the particles of a body."""
        return torch.sigmoid(_GUIDED_GAIN * self.network(torch.einsum("bkp,bpf->bkf", weights, features)))


def elastic(motion: BodyMotion, materials: Materials) -> Float[Tensor, "batch body 3 3"]:
    """Return the strains of a damped oscillation about the first shape; one semi-implicit step, stable for any."""
    eye = torch.eye(3, dtype=motion.strains.dtype, device=motion.strains.device)
    carried = motion.strains * (1 - materials.damping)[..., None]
    return carried - materials.stiffness[..., None] * (motion.stretches - eye)


def _logit(share: float) -> float:
    return math.log(share / (1 - share))
