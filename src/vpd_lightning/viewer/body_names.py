"""What a person calls the bodies of a scene: by colour and kind, numbered where that is not enough."""

import colorsys
from collections import Counter
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int64
from numpy.typing import NDArray

KINDS = {"mujoco_block": "block", "deformable_collision": "soft body"}
"""The word for a body of a generated scene; "body" in all others."""

_HUES = ((15, "red"), (45, "orange"), (70, "yellow"), (165, "green"), (195, "cyan"), (255, "blue"), (330, "purple"))
_GREY_SATURATION = 0.25


def color_name(rgb: Sequence[float]) -> str:
    """Return the everyday word for a colour (sRGB in [0, 1])."""
    hue, saturation, value = colorsys.rgb_to_hsv(*rgb)
    if value < 0.2:
        return "black"
    if saturation < _GREY_SATURATION:
        return "white" if value > 0.8 else "grey"
    return next((name for limit, name in _HUES if 360 * hue < limit), "red")


def body_names(scene: str, clusters: Int64[NDArray, " particle"], colors: Float[NDArray, "particle 3"]) -> list[str]:
    """Return a name for each cluster (from 0) of a scene; ``colors`` are sRGB in [0, 1].

    A single body needs no colour; bodies of one name are numbered.
    """
    kind, count = KINDS.get(scene, "body"), int(clusters.max(initial=-1)) + 1
    if count == 1:
        return [kind]
    names = [f"{color_name(np.median(colors[clusters == number], axis=0).tolist())} {kind}" for number in range(count)]
    total, seen, numbered = Counter(names), Counter[str](), []
    for name in names:
        seen[name] += 1
        numbered.append(f"{name} {seen[name]}" if total[name] > 1 else name)
    return numbered
