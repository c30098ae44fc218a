"""The random initial state: which bodies there are, how they are turned and where they hang above the floor."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from data_gen.deformable.settings import DeformableSettings
from data_gen.deformable.tetrahedra import TetrahedralMesh, mesh
from data_gen.settings import SPLIT_CODES
from vpd_lightning.errors import DataError

_MAX_DRAWS = 1000


@dataclass(frozen=True)
class Drop:
    """Bodies at rest in the air, lowest first."""

    shapes: tuple[str, ...]
    meshes: tuple[TetrahedralMesh, ...]  # in the bodies' own frames
    vertices: tuple[NDArray[np.float64], ...]  # (vertex, 3) m, world


def draw_drop(settings: DeformableSettings, seed: int, split: str, index: int, attempt: int = 0) -> Drop:
    """Draw shapes, orientations and positions; depends on seed, split, index and attempt alone.

    Orientations are uniform over all rotations. Each body hangs a random gap above the highest point of the one below.
    Draws that reach above ``drop.highest`` are drawn again.
    """
    sub_seed = [attempt] if attempt else []
    generator = np.random.default_rng([seed, SPLIT_CODES[split], index, *sub_seed])
    pool, count, drop = list(settings.bodies.shapes), settings.bodies.count, settings.drop
    names = tuple(str(name) for name in generator.choice(pool, count, replace=count > len(pool)))
    meshes = tuple(mesh(name, settings.bodies.spacing) for name in names)
    for _ in range(_MAX_DRAWS):
        placed, height = [], 0.0
        for body in meshes:
            quaternion = generator.normal(size=4)
            points = Rotation.from_quat(quaternion).apply(body.vertices)
            offset = generator.uniform(-drop.offset, drop.offset, 2)
            lift = height + generator.uniform(drop.gap_min, drop.gap_max) - points[:, 2].min()
            placed.append(points + [*offset, lift])
            height = float(placed[-1][:, 2].max())
        if height <= drop.highest:
            return Drop(names, meshes, tuple(placed))
    raise DataError(
        f"No initial state of {', '.join(names)} stays below drop.highest={drop.highest} m.\n"
        "Raise drop.highest, or lower drop.gap_min or bodies.count."
    )
