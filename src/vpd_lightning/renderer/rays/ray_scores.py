"""What the ray search may rank particles by."""

from dataclasses import dataclass


@dataclass(frozen=True)
class BesideRay:
    """Score by the squared distance beside the ray; particles outside [near, far] along the ray are left out."""

    near: float
    far: float


@dataclass(frozen=True)
class BesideAndBehind:
    """Score by the squared distance beside the ray, and by how far behind the first surface.

    ``beside^2 + 0.04 max(0, along - first - depth)^2``, where ``first`` is the smallest ``along`` of all particles
    within ``width`` of the ray (of those farther away, ``500 / width max(0, beside^2 - width^2)`` is added). What is
    closer than ``near``, or behind the camera, is left out. Nothing in it depends on the unit of length.
    """

    near: float
    width: float
    depth: float

    @property
    def steepness(self) -> float:
        """What a square metre beyond ``width`` counts, in metres."""
        return 500 / self.width


RayScore = BesideRay | BesideAndBehind
