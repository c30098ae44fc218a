"""Inputs that break careless arithmetic: one table of point sets, and the precisions in which everything is tried."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass

import torch
from torch import Tensor

SPACING = 0.1
"""Distance between neighbouring points of the ordinary scene (metres); radii and bandwidths are made of it."""


@dataclass(frozen=True)
class Mode:
    """A precision: the type of the inputs, and whether autocast to bfloat16 is on around the call."""

    name: str
    dtype: torch.dtype
    is_autocast: bool = False

    def context(self, device: torch.device) -> AbstractContextManager[None]:
        return torch.autocast(device.type, dtype=torch.bfloat16, enabled=self.is_autocast)

    @property
    def eps(self) -> float:
        return torch.finfo(self.dtype).eps

    @property
    def smallest_distance(self) -> float:
        """Below this a difference's square is no normal number any more, and loses digits or all of itself."""
        return 2 * torch.finfo(self.dtype).tiny ** 0.5


MODES = (Mode("float32", torch.float32), Mode("bf16", torch.float32, is_autocast=True), Mode("float64", torch.float64))


@dataclass(frozen=True)
class HardScene:
    """Points and queries in float64, and the distance between neighbours, which sets the kernels' size (metres)."""

    points: Tensor
    queries: Tensor
    spacing: float = SPACING

    def to(self, mode: Mode, device: torch.device) -> "HardScene":
        """Round the coordinates to the precision under test: a reference must start from the same numbers."""
        return HardScene(self.points.to(device, mode.dtype), self.queries.to(device, mode.dtype), self.spacing)


def cloud(count: int = 70, seed: int = 0) -> Tensor:
    """Return points on a ball over a floor, as an encoder gives them: about a metre across."""
    generator = torch.Generator().manual_seed(seed)
    normal = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    ball = 0.3 * normal / normal.norm(dim=-1, keepdim=True) + normal.new_tensor([0.0, 0.0, 0.3])
    floor = torch.rand(count, 3, generator=generator, dtype=torch.float64) - 0.5
    floor[:, 2] = 0.0
    return torch.where((torch.arange(count) % 2 == 0)[:, None], ball, floor)


def samples(count: int = 33) -> Tensor:
    """Return places between and around the points of ``cloud``."""
    generator = torch.Generator().manual_seed(1)
    return torch.rand(count, 3, generator=generator, dtype=torch.float64) * 1.2 - 0.6


def scaled(factor: float) -> HardScene:
    return HardScene(cloud() * factor, torch.cat([samples(), cloud()[:8]]) * factor, SPACING * factor)


def translated(distance: float) -> HardScene:
    shift = torch.tensor([1.0, -0.7, 0.4], dtype=torch.float64) * distance
    return HardScene(cloud() + shift, torch.cat([samples(), cloud()[:8]]) + shift)


def _only(count: int) -> HardScene:
    return HardScene(cloud()[:count], torch.cat([samples(), cloud()[:1]]))


def _duplicates() -> HardScene:
    points = torch.cat([cloud(), cloud()[:1].expand(3000, 3)])
    return HardScene(points, torch.cat([samples(), cloud()[:4]]))


def _lattice() -> HardScene:
    axis = torch.arange(5, dtype=torch.float64) * SPACING
    points = torch.cartesian_prod(axis, axis, axis)
    return HardScene(points, torch.cat([points[::7], points[::9] + SPACING / 2]))


def _line() -> HardScene:
    direction = torch.tensor([[0.6, 0.0, 0.8]], dtype=torch.float64)
    return HardScene(torch.linspace(-0.5, 0.5, 40, dtype=torch.float64)[:, None] * direction, samples())


def _plane() -> HardScene:
    return HardScene(cloud() * torch.tensor([1.0, 1.0, 0.0]), samples())


def _all_scales() -> HardScene:
    sizes = torch.logspace(-6, 6, 70, dtype=torch.float64)[:, None]
    return HardScene(cloud() * sizes, samples(70) * sizes)


def _far_apart() -> HardScene:
    return HardScene(torch.cat([cloud(), cloud() + 1e6]), torch.cat([samples(), samples() + 1e6, samples() + 5e5]))


SCENES: dict[str, Callable[[], HardScene]] = {
    "ordinary": lambda: HardScene(cloud(), samples()),
    "queries_on_particles": lambda: HardScene(cloud(), cloud()),
    "queries_beside_particles": lambda: HardScene(cloud(), cloud() + 1e-7),
    "thousands_of_duplicates": _duplicates,
    "all_the_same": lambda: HardScene(cloud()[:1].expand(2000, 3), torch.cat([cloud()[:2], samples(5)])),
    "no_particle": lambda: _only(0),
    "one_particle": lambda: _only(1),
    "k_minus_1_particles": lambda: _only(15),
    "k_particles": lambda: _only(16),
    "k_plus_1_particles": lambda: _only(17),
    "lattice_of_ties": _lattice,
    "on_a_line": _line,
    "in_a_plane": _plane,
    "all_scales_at_once": _all_scales,
    "clusters_1e6_apart": _far_apart,
    "queries_far_away": lambda: HardScene(cloud(), samples() + 1e6),
    "float32_denormals": lambda: HardScene(cloud() * 1e-40, torch.cat([samples(), cloud()]) * 1e-40),
    "float64_denormals": lambda: HardScene(cloud() * 1e-310, torch.cat([samples(), cloud()]) * 1e-310),
    **{f"scaled_{factor:g}": (lambda f=factor: scaled(f)) for factor in (1e-6, 1e-4, 1e-2, 1e2, 1e4, 1e6)},
    **{f"translated_{shift:g}": (lambda s=shift: translated(s)) for shift in (1e3, 1e4, 1e5, 1e6)},
}


def is_finite(*tensors: Tensor | None) -> bool:
    return all(tensor is None or bool(torch.isfinite(tensor).all()) for tensor in tensors)


def rotation() -> Tensor:
    """Return a rotation that maps no axis to an axis (float64)."""
    axis = torch.tensor([0.36, 0.48, 0.8], dtype=torch.float64)
    skew = torch.linalg.cross(axis.expand(3, 3), torch.eye(3, dtype=torch.float64)).T
    return torch.linalg.matrix_exp(1.1 * skew)
