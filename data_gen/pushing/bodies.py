"""What lies on the table: shapes, sizes, masses, frictions, colours and places drawn at random."""

import colorsys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from data_gen.pushing.settings import PushingSettings

_MAX_TRIALS = 1000


@dataclass(frozen=True)
class PlacedBody:
    """One body; half sizes are those of its bounding box along its own axes, metres."""

    shape: str
    half_sizes: NDArray[np.float64]  # (3,)
    mass: float  # kg
    friction: float
    colors: tuple[NDArray[np.float64], NDArray[np.float64]]  # of its checker, sRGB
    place: NDArray[np.float64]  # (2,) m, on the table
    yaw: float  # radians

    @property
    def reach(self) -> float:
        """Farthest distance of the body from its upright axis, metres."""
        return float(np.hypot(*self.half_sizes[:2])) if self.shape == "box" else float(self.half_sizes[:2].max())

    @property
    def rolls(self) -> bool:
        """Whether it rolls on from where it is pushed to."""
        return self.shape in ("sphere", "capsule", "ellipsoid")

    @property
    def mjcf_size(self) -> NDArray[np.float64]:
        """Size as MJCF has it for the shape."""
        half = self.half_sizes
        return {
            "box": half,
            "ellipsoid": half,
            "sphere": half[:1],
            "cylinder": half[[0, 2]],
            "capsule": np.array([half[1], half[0] - half[1]]),  # lying: its axis is x
        }[self.shape]


def between(ends: Sequence[float], generator: np.random.Generator) -> float:
    """Draw evenly between the least and the largest."""
    least, largest = ends
    return float(generator.uniform(least, largest))


def draw_bodies(settings: PushingSettings, generator: np.random.Generator) -> list[PlacedBody]:
    """Draw bodies that do not touch each other or reach over the table's edge."""
    count = int(generator.integers(settings.bodies.count_min, settings.bodies.count_max + 1))
    while True:
        placed: list[PlacedBody] = []
        for _ in range(_MAX_TRIALS):
            body = _draw_body(settings, generator)
            gap = settings.bodies.margin
            if all(np.hypot(*(body.place - other.place)) > body.reach + other.reach + gap for other in placed):
                placed.append(body)
            if len(placed) == count:
                return placed
        count -= 1  # the table is too small for so many


def _draw_body(settings: PushingSettings, generator: np.random.Generator) -> PlacedBody:
    ranges = settings.bodies
    shape = str(generator.choice(list(ranges.shapes)))
    half = np.array([between(ranges.half_size, generator) for _ in range(3)])
    if shape == "sphere":
        half[:] = half[0]
    elif shape == "cylinder":
        half[1] = half[0]
    elif shape == "capsule":
        half[1:] = min(half[1:].min(), 0.7 * half[0])
    hue = generator.uniform()
    colors = tuple(np.array(colorsys.hsv_to_rgb(hue, 0.75, value)) for value in (0.85, 0.6))
    body = PlacedBody(
        shape=shape,
        half_sizes=half,
        mass=between(ranges.mass, generator),
        friction=between(ranges.friction, generator),
        colors=colors,  # type: ignore[arg-type]
        place=np.zeros(2),
        yaw=float(generator.uniform(0, 2 * np.pi)),
    )
    limit = np.asarray(settings.table.half_size) - body.reach - ranges.margin
    body.place[:] = generator.uniform(-limit, limit)
    return body
