"""Meshes, textures and collision parts as MuJoCo wants them: MJCF text, and pictures for the compiled model."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from data_gen.movi.collision_parts import CollisionPart
from data_gen.movi.mesh import Mesh


def mesh_xml(name: str, mesh: Mesh) -> str:
    """Return the ``<mesh>`` asset of ``mesh`` (normals and texture coordinates with it where it has them).

    MuJoCo moves a mesh to its centre of mass and turns it into its principal axes, and moves the geom back: a geom
    without ``pos`` shows the vertices where they stand in ``mesh``. Its inertia is that of the convex hull, because
    the exact one refuses meshes that are open or overlap themselves.
    """
    parts = [f'<mesh name="{name}" inertia="convex" vertex="{_numbers(mesh.vertices)}"']
    if mesh.normals is not None:
        parts.append(f'normal="{_numbers(mesh.normals)}"')
    if mesh.texcoords is not None:
        # MuJoCo's v runs down the picture, as its rows do.
        parts.append(f'texcoord="{_numbers(mesh.texcoords * [1.0, -1.0] + [0.0, 1.0])}"')
    faces = " ".join(map(str, mesh.faces.reshape(-1).tolist()))
    return " ".join(parts) + f' face="{faces}"/>'


def texture_xml(name: str, texture: NDArray[np.uint8]) -> str:
    """Return an empty ``<texture>`` asset of the size of ``texture``; ``paint`` fills it after compiling.

    Use it with ``<material texture="name"/>`` (no ``texuniform``, no ``texrepeat``).
    """
    height, width = texture.shape[:2]
    return f'<texture name="{name}" type="2d" builtin="flat" rgb1="1 1 1" width="{width}" height="{height}"/>'


def paint(model: Any, name: str, texture: NDArray[np.uint8]) -> None:
    """Write ``texture`` (height, width, 3) into the compiled model, before a renderer uploads it."""
    slot = model.texture(name)
    if (int(slot.height[0]), int(slot.width[0]), int(slot.nchannel[0])) != texture.shape:
        raise ValueError(f"texture {name} is {slot.height[0]}x{slot.width[0]}x{slot.nchannel[0]}, not {texture.shape}")
    start = int(slot.adr[0])
    model.tex_data[start : start + texture.size] = texture.reshape(-1)


def part_attributes(part: CollisionPart, mesh_name: str | None = None) -> str:
    """Return type, size, position and orientation of a ``<geom>`` for a collision part.

    ``mesh_name`` is the asset made with ``mesh_xml(mesh_name, part.mesh)``, needed for parts of kind ``mesh``.
    """
    place = f'pos="{_numbers(part.position)}" quat="{_numbers(part.quaternion)}"'
    if part.kind == "mesh":
        if mesh_name is None:
            raise ValueError("a part of kind mesh needs the name of its mesh asset")
        return f'type="mesh" mesh="{mesh_name}" {place}'
    return f'type="{part.kind}" size="{_numbers(np.asarray(part.size))}" {place}'


def _numbers(values: NDArray[np.float64]) -> str:
    return " ".join(f"{value:.7g}" for value in np.asarray(values, dtype=np.float64).reshape(-1).tolist())
