"""Which objects are thrown, and from where with what velocity; as Kubric's MOVi workers do it."""

import colorsys
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_gen.movi.catalogue import Catalogue, Item
from data_gen.movi.collision_parts import rotation_matrix
from data_gen.movi.settings import MaterialSettings, MoviSettings
from vpd_lightning.errors import ConfigError

# CLEVR's eight colours (Johnson et al., 2017), sRGB: blue brown cyan grey green purple red yellow.
CLEVR_COLORS = (
    (42, 75, 215), (129, 74, 25), (41, 208, 208), (87, 87, 87), (29, 105, 20), (129, 38, 192), (173, 35, 35),
    (255, 238, 51),
)  # fmt: skip
_WHITE = (1.0, 1.0, 1.0)
_PARKING = 1000.0  # m, distance of objects that are not placed yet


@dataclass(frozen=True, eq=False)
class ThrownObject:
    """One object of a trajectory; its item is scaled to size."""

    item: Item
    size: float  # m, longest side
    material: MaterialSettings
    color: tuple[float, float, float]  # sRGB, 0 to 1

    @property
    def mass(self) -> float:
        """Kilograms."""
        return self.item.volume * self.material.density


def draw_objects(settings: MoviSettings, catalogue: Catalogue, generator: np.random.Generator) -> list[ThrownObject]:
    """Return the objects of a trajectory."""
    return [_draw_object(settings, catalogue, generator) for _ in range(settings.objects.count)]


def _draw_object(settings: MoviSettings, catalogue: Catalogue, generator: np.random.Generator) -> ThrownObject:
    objects = settings.objects
    item = catalogue.draw(generator)
    if objects.size_choice == "one_of":
        size = objects.sizes[int(generator.integers(len(objects.sizes)))]
    else:
        size = float(generator.uniform(objects.sizes[0], objects.sizes[1]))
    color = _WHITE
    if objects.color == "clevr":
        red, green, blue = CLEVR_COLORS[int(generator.integers(len(CLEVR_COLORS)))]
        color = (red / 255, green / 255, blue / 255)
    elif objects.color == "hue":
        color = colorsys.hsv_to_rgb(float(generator.uniform()), 1.0, 1.0)
    material = objects.materials[int(generator.integers(len(objects.materials)))]
    return ThrownObject(item.scaled(size), size, material, color)


def place(
    settings: MoviSettings, objects: list[ThrownObject], model: Any, data: Any, generator: np.random.Generator
) -> None:
    """Write positions, orientations and velocities into ``data`` such that no two bodies touch.

    Raises:
        ConfigError: no room was found for the objects in the region.
    """
    import mujoco

    throw = settings.throw
    for _ in range(throw.max_trials):
        mujoco.mj_resetData(model, data)
        data.qpos[2::7] = _PARKING * np.arange(1, len(objects) + 1)
        if all(_place_one(settings, number, object_, model, data, generator) for number, object_ in enumerate(objects)):
            break
    else:
        raise ConfigError(
            f"No room for {len(objects)} objects between throw.region_min={throw.region_min} and "
            f"throw.region_max={throw.region_max}.\nEnlarge the region, or choose fewer or smaller objects."
        )
    for number in range(len(objects)):
        towards_middle = -data.qpos[7 * number : 7 * number + 2]
        velocity = generator.uniform(-1.0, 1.0, 3) * throw.velocity_max
        velocity[:2] += towards_middle
        data.qvel[6 * number : 6 * number + 3] = velocity


def _place_one(
    settings: MoviSettings,
    number: int,
    thrown: ThrownObject,
    model: Any,
    data: Any,
    generator: np.random.Generator,
) -> bool:
    import mujoco

    for _ in range(settings.throw.max_trials):
        quaternion = generator.normal(size=4)
        quaternion /= np.linalg.norm(quaternion)
        position = _draw_position(settings, thrown.item.mesh.vertices @ rotation_matrix(quaternion).T, generator)
        data.qpos[7 * number : 7 * number + 7] = np.concatenate([position, quaternion])
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        if data.ncon == 0:
            return True
    return False


def _draw_position(
    settings: MoviSettings, turned: NDArray[np.float64], generator: np.random.Generator
) -> NDArray[np.float64]:
    """Draw a centre for which the turned vertices' bounding box lies in the region (or covers it, if it is larger)."""
    ends = np.stack(
        [
            np.asarray(settings.throw.region_min) - turned.min(axis=0),
            np.asarray(settings.throw.region_max) - turned.max(axis=0),
        ]
    )
    return generator.uniform(ends.min(axis=0), ends.max(axis=0))
