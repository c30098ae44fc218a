"""MuJoCo's lights in linear light.

MuJoCo adds up light in sRGB. Here a level floor comes out as bright as there, in the light and in full shadow (before
light that bounces); surfaces that face the light more come out darker than MuJoCo's, those that face it less, brighter.
"""

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

_KINDS = {mujoco.mjtLightType.mjLIGHT_DIRECTIONAL: "sun", mujoco.mjtLightType.mjLIGHT_SPOT: "spot"}
_AMBIENT_WITHOUT_LIGHTS = 0.3  # MuJoCo's

Floats = NDArray[np.float64]


def linear(color: Floats) -> Floats:
    """Decode sRGB to linear light; goes on above 1."""
    values = np.asarray(color, float)
    return np.where(values <= 0.04045, values / 12.92, ((np.maximum(values, 0) + 0.055) / 1.055) ** 2.4)


def ambient_light(scene: Any) -> Floats:
    """Return the ambient light of an ``mjvScene``, sRGB."""
    lights = scene.lights[: scene.nlight]
    return np.sum([light.ambient for light in lights], axis=0) if lights else np.full(3, _AMBIENT_WITHOUT_LIGHTS)


def _slope(light: Any) -> float:
    """Return the cosine at which light falls on a level floor; 1 for light that does not come from above."""
    direction = np.asarray(light.dir, float)
    down = -float(direction[2]) / max(float(np.linalg.norm(direction)), 1e-9)
    return down if down > 0 and not light.headlight else 1.0


def describe_lights(scene: Any) -> tuple[list[dict[str, Any]], list[str]]:
    """Return the lamps (linear strength; 1 shows a white surface that faces it as white) and what is left out."""
    lights = [light for light in scene.lights[: scene.nlight] if np.any(light.diffuse)]
    ambient = ambient_light(scene)
    slopes = [_slope(light) for light in lights]
    on_floor = np.sum([light.diffuse * slope for light, slope in zip(lights, slopes, strict=True)], axis=0)
    share = (linear(ambient + on_floor) - linear(ambient)) / np.maximum(on_floor, 1e-9)
    unknown = [mujoco.mjtLightType(light.type).name for light in lights if light.type not in _KINDS]
    described = [
        {
            "kind": _KINDS[mujoco.mjtLightType(light.type)],
            "is_headlight": bool(light.headlight),
            "strength": (share * light.diffuse).tolist(),
            "position": np.asarray(light.pos, float).tolist(),
            "direction": np.asarray(light.dir, float).tolist(),
            "cutoff": float(np.radians(light.cutoff)),
            "casts_shadow": bool(light.castshadow),
        }
        for light in lights
        if light.type in _KINDS
    ]
    return described, unknown
