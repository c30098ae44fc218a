import torch

from vpd_lightning.dynamics.persistence import PersistenceDynamics
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.types import Particles


def test_nothing_changes() -> None:
    previous, current = (Particles(torch.rand(2, 5, 3), torch.rand(2, 5, 4)) for _ in range(2))
    dynamics, keys = PersistenceDynamics(), RandomKeys.fixed(2)
    following, memory = dynamics(previous, current, dynamics.initialize(previous, current, keys), keys, 0)
    assert following is current and memory is None
    assert not list(dynamics.parameters())
