"""Rotations as people write them: a quaternion (w, x, y, z), or an axis and an angle."""

import math
from collections.abc import Sequence
from typing import Any, TypeAlias

import torch
from jaxtyping import Float
from torch import Tensor

from vpd_lightning.errors import EditError
from vpd_lightning.geometry.rotations import rotation_matrix

Numbers: TypeAlias = Any
"""One number or several as a caller or a file gives them; a constructor checks them and keeps a plain tuple."""

Quaternion = tuple[float, float, float, float]

NO_ROTATION: Quaternion = (1.0, 0.0, 0.0, 0.0)


def vector_of(value: Numbers, name: str, length: int = 3) -> tuple[float, ...]:
    """Return ``length`` finite numbers.

    Raises:
        EditError: it is something else.
    """
    try:
        numbers = tuple(float(number) for number in value)
    except (TypeError, ValueError):
        numbers = ()
    if len(numbers) != length or not all(math.isfinite(number) for number in numbers):
        raise EditError(f"{name} is {value!r}.\nAllowed: {length} finite numbers.")
    return numbers


def quaternion_of(value: Numbers, name: str) -> Quaternion:
    """Return a unit quaternion (w, x, y, z) of four numbers or of a rotation matrix (3, 3).

    Raises:
        EditError: neither of both.
    """
    if isinstance(value, Tensor) and value.shape == (3, 3):
        return _from_matrix(value, name)
    w, x, y, z = vector_of(value, name, 4)
    length = math.sqrt(w * w + x * x + y * y + z * z)
    if length < 1e-9:
        raise EditError(f"{name} is {value!r}.\nAllowed: a quaternion w, x, y, z other than zero.")
    return (w / length, x / length, y / length, z / length)


def about_axis(axis: Sequence[float], degrees: float) -> Quaternion:
    """Return the rotation by an angle (degrees, counter-clockwise) about an axis of any length but zero.

    Raises:
        EditError: the axis is zero or not three numbers.
    """
    x, y, z = vector_of(axis, "axis")
    length = math.sqrt(x * x + y * y + z * z)
    if length < 1e-9 or not math.isfinite(degrees):
        raise EditError(
            f"A rotation by {degrees} degrees about {tuple(axis)} is undefined.\nGive a nonzero axis and finite angle."
        )
    half = math.radians(degrees) / 2
    share = math.sin(half) / length
    return (math.cos(half), share * x, share * y, share * z)


def matrix_of(quaternion: Quaternion) -> Float[Tensor, "3 3"]:
    """Return the rotation matrix (float64) of a unit quaternion."""
    return rotation_matrix(torch.tensor(quaternion, dtype=torch.float64))


def _from_matrix(matrix: Tensor, name: str) -> Quaternion:
    from scipy.spatial.transform import Rotation

    rotation = matrix.detach().to("cpu", torch.float64)
    eye = torch.eye(3, dtype=torch.float64)
    if not torch.allclose(rotation @ rotation.T, eye, atol=1e-5) or torch.linalg.det(rotation) < 0:
        raise EditError(
            f"{name} is no rotation matrix.\nAllowed: an orthonormal one of determinant 1, or a quaternion."
        )
    x, y, z, w = Rotation.from_matrix(rotation.numpy()).as_quat().tolist()
    return (w, x, y, z)
