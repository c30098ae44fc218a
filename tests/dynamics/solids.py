"""Cubes and balls as points with colours and normals, drawn at random from their surfaces. Metres."""

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

FACES = [(0, 1), (0, -1), (1, 1), (1, -1), (2, 1), (2, -1)]
COLORS = torch.tensor(
    [[0.8, 0.1, 0.1], [0.1, 0.8, 0.1], [0.1, 0.1, 0.8], [0.8, 0.8, 0.1], [0.1, 0.8, 0.8], [0.8, 0.1, 0.8]]
)
UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def cube(
    count: int, seed: int, half: float = 0.15, dtype: torch.dtype = torch.float64, num_faces: int = 5
) -> tuple[Tensor, Tensor, Tensor]:
    """Points, colours and normals of a cube about the origin, each face of its colour; with five, no bottom."""
    generator = torch.Generator().manual_seed(seed)
    face = torch.randint(0, num_faces, (count,), generator=generator)
    positions = (torch.rand(count, 3, generator=generator, dtype=dtype) * 2 - 1) * half
    normals = torch.zeros(count, 3, dtype=dtype)
    for number, (axis, sign) in enumerate(FACES[:num_faces]):
        positions[face == number, axis] = sign * half
        normals[face == number, axis] = sign
    return positions, COLORS[face].to(dtype), normals


def ball(count: int, seed: int, radius: float = 0.15, is_plain: bool = False) -> tuple[Tensor, Tensor, Tensor]:
    """Points, colours and normals of a ball about the origin; plain, or with a colour for each direction."""
    generator = torch.Generator().manual_seed(seed)
    normals = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, dtype=torch.float64), dim=-1)
    colors = torch.full_like(normals, 0.5) if is_plain else 0.5 + 0.4 * normals
    return radius * normals, colors, normals


def even_cube(side: int, half: float = 0.15) -> tuple[Tensor, Tensor]:
    """Points and normals of a full cube, ``side`` x ``side`` on each of its six faces, symmetric about the origin."""
    axis = (torch.arange(side, dtype=torch.float64) + 0.5) / side * 2 - 1
    u, v = (values.flatten() for values in torch.meshgrid(axis, axis, indexing="ij"))
    positions, normals = [], []
    for number, sign in FACES:
        others = [other for other in range(3) if other != number]
        face, normal = torch.zeros(side**2, 3, dtype=torch.float64), torch.zeros(side**2, 3, dtype=torch.float64)
        face[:, number] = normal[:, number] = sign
        face[:, others[0]], face[:, others[1]] = u, v
        positions.append(half * face)
        normals.append(normal)
    return torch.cat(positions), torch.cat(normals)


def even_ball(count: int, radius: float = 0.15) -> tuple[Tensor, Tensor]:
    """Points and normals of a ball, evenly spread (a Fibonacci spiral) with their mirror images."""
    half = torch.arange(count // 2, dtype=torch.float64)
    height = (half + 0.5) / (count // 2)
    angle = half * torch.pi * (3 - 5**0.5)
    ring = (1 - height.square()).sqrt()
    upper = torch.stack([ring * angle.cos(), ring * angle.sin(), height], dim=-1)
    normals = torch.cat([upper, -upper])
    return radius * normals, normals


def rotation_about(axis, angle: float) -> Tensor:
    axis = torch.tensor(axis, dtype=torch.float64)
    return torch.from_numpy(Rotation.from_rotvec((axis / axis.norm() * angle).numpy()).as_matrix())


def random_rotation(seed: int) -> Tensor:
    return torch.from_numpy(Rotation.random(rng=seed).as_matrix())
