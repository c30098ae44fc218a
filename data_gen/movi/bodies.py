"""Families of everyday bodies with random proportions: closed meshes with texture coordinates, z up."""

import numpy as np
from numpy.typing import NDArray

from data_gen.movi.mesh import Mesh, join
from data_gen.movi.signed_distance import Distance, ellipsoid, limb, mirrored, split_quads, surface, union
from data_gen.movi.sweeps import grid_mesh, revolution

_AROUND = 28  # corners of a vessel's circles


def package(generator: np.random.Generator) -> Mesh:
    """A box with rounded edges; its texture holds the six faces in three columns and two rows."""
    half = 0.5 * np.sort(generator.uniform(0.15, 1.0, 3))[generator.permutation(3)]
    round_off = float(half.min() * generator.uniform(0.04, 0.45))
    vertices: list[NDArray[np.float64]] = []
    quads, texcoords = [], []
    for face in range(6):
        axis, side = face // 2, 1 - 2 * (face % 2)
        right, up = (axis + 1) % 3, (axis + 2) % 3
        ticks = [_box_ticks(half[i], round_off) for i in (right, up)]
        u, v = np.meshgrid(*ticks)
        point = np.zeros((*u.shape, 3))
        point[..., axis], point[..., right], point[..., up] = side * half[axis], u, v
        core = np.clip(point, round_off - half, half - round_off)
        outwards = point - core
        point = core + round_off * outwards / np.linalg.norm(outwards, axis=-1, keepdims=True)
        rows, columns = u.shape
        start = np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)
        quad = np.stack([start, start + 1, start + columns + 1, start + columns], axis=-1).reshape(-1, 4)
        quads.append((quad if side > 0 else quad[:, ::-1]) + sum(map(len, vertices)))
        vertices.append(point.reshape(-1, 3))
        share = np.stack([0.5 + 0.5 * side * u / half[right], 0.5 + 0.5 * v / half[up]], axis=-1).reshape(-1, 2)
        texcoords.append((np.array([face % 3, face // 3]) + 0.02 + 0.96 * share) / [3.0, 2.0])
    points = np.concatenate(vertices)
    return Mesh(points, split_quads(points, np.concatenate(quads)), np.concatenate(texcoords))


def bottle(generator: np.random.Generator) -> Mesh:
    """A full body of revolution: a can, bottle, vase or chess piece."""
    count = int(generator.integers(3, 6))
    radii = generator.uniform(0.25, 1.0, count)
    if generator.random() < 0.5:  # shoulders and a neck
        radii = np.array(
            [1.0, 1.0, generator.uniform(0.8, 1.1), generator.uniform(0.25, 0.5), generator.uniform(0.25, 0.5)]
        )
    radii *= generator.uniform(0.18, 0.45)
    height = np.linspace(0.0, 1.0, 15)
    side = np.maximum(_smooth(radii, height), 0.06)
    rim = 0.012
    profile = [
        (0.0, 0.0),
        (side[0] - rim, 0.0),
        *zip(side, rim + (1 - 2 * rim) * height, strict=True),
        (side[-1] - rim, 1.0),
        (0.0, 1.0),
    ]
    return revolution(profile, _AROUND)


def bowl(generator: np.random.Generator) -> Mesh:
    """An open vessel with a wall, from a plate to a vase."""
    tall = generator.uniform(0.15, 1.2)
    radii = np.concatenate(
        [generator.uniform(0.3, 0.6, 1), generator.uniform(0.5, 1.0, 2), generator.uniform(0.5, 1.0, 1)]
    )
    return revolution(_vessel(np.sort(radii) if tall < 0.6 else radii, tall, generator.uniform(0.05, 0.1)), _AROUND)


def mug(generator: np.random.Generator) -> Mesh:
    """A cup with a handle, whose ends sit in the wall."""
    tall = generator.uniform(0.7, 1.3)
    radii = 0.5 * (1.0 + 0.25 * generator.uniform(-1, 1, 3))
    wall = 0.07
    cup = revolution(_vessel(radii, tall, wall), _AROUND)
    low, high = tall * generator.uniform(0.12, 0.25), tall * generator.uniform(0.7, 0.88)
    reach = generator.uniform(0.2, 0.4)
    angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 13)
    inset = np.interp([low, high], np.linspace(0, tall, 15), _smooth(radii, np.linspace(0, 1, 15))) - 0.6 * wall
    base = inset[0] + (inset[1] - inset[0]) * (np.sin(angle) + 1) / 2
    middle = np.stack(
        [base + reach * np.cos(angle) ** 0.8, 0 * angle, (low + high) / 2 + (high - low) / 2 * np.sin(angle)], 1
    )
    tangent = np.gradient(middle, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    across = np.cross(tangent, [0.0, 1.0, 0.0])
    turn = 2 * np.pi * np.arange(10) / 10
    thick = generator.uniform(0.04, 0.08)
    # (y, across, tangent) is left-handed, hence the minus.
    offset = np.cos(turn)[:, None] * np.array([0.0, 1.3, 0.0]) - np.sin(turn)[:, None] * across[:, None]
    rings = middle[:, None] + thick * offset
    ends = [np.repeat(middle[i][None, None], 10, axis=1) for i in (0, -1)]
    handle = grid_mesh(np.concatenate([ends[0], rings, ends[1]]))
    assert handle.texcoords is not None
    return join([cup, Mesh(handle.vertices, handle.faces, handle.texcoords * [1.0, 0.1])])


def superquadric(generator: np.random.Generator) -> Mesh:
    """A body between box, ellipsoid and octahedron."""
    bend, flat = generator.uniform(0.25, 1.8, 2)
    radii = generator.uniform(0.3, 1.0, 3)
    around, up = 2 * np.pi * np.arange(32) / 32, np.linspace(-np.pi / 2, np.pi / 2, 19)
    ring = np.stack([_power(np.cos(around), bend), _power(np.sin(around), bend)], axis=-1)
    points = np.zeros((19, 32, 3))
    points[..., :2] = np.maximum(_power(np.cos(up), flat), 0.0)[:, None, None] * ring
    points[0, :, :2] = points[-1, :, :2] = 0.0
    points[..., 2] = _power(np.sin(up), flat)[:, None]
    taper = 1.0 + generator.uniform(-0.4, 0.4) * points[..., 2:]
    points[..., :2] *= taper
    return grid_mesh(points * radii)


def lump(generator: np.random.Generator) -> Mesh:
    """A smooth bumpy body: a sphere whose radius follows a few random waves."""
    around, up = 2 * np.pi * np.arange(36) / 36, np.linspace(-np.pi / 2, np.pi / 2, 21)
    unit = np.stack(
        [np.cos(up)[:, None] * np.cos(around), np.cos(up)[:, None] * np.sin(around), np.sin(up)[:, None] * np.ones(36)],
        axis=-1,
    )
    unit[0], unit[-1] = (0.0, 0.0, -1.0), (0.0, 0.0, 1.0)
    ways = generator.normal(size=(8, 3)) * generator.uniform(1.0, 3.5)
    waves = np.cos(unit @ ways.T + generator.uniform(0, 2 * np.pi, 8)) @ generator.normal(size=8)
    radius = np.exp(generator.uniform(0.1, 0.3) * waves / np.sqrt(4.0))
    return grid_mesh(radius[..., None] * unit * generator.uniform(0.5, 1.0, 3))


def shoe(generator: np.random.Generator) -> Mesh:
    """A shoe from heel (-x) to toe (+x): cross-sections with a flat sole, and a hollow where the foot goes in."""
    along = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, 24))
    width = 0.16 * _smooth(np.array([0.75, 0.85, 0.75, 0.95, 1.05, 0.6]) * generator.uniform(0.85, 1.15, 6), along)
    ankle, toe = generator.uniform(0.28, 0.6), generator.uniform(0.12, 0.2)
    top = _smooth(np.array([ankle, 0.97 * ankle, 0.8 * ankle, (ankle + toe) / 2.4, toe, 0.75 * toe]), along)
    blunt = np.sqrt(np.clip(1.0 - np.abs(2 * along - 1) ** generator.uniform(5.0, 9.0), 0.0, 1.0))
    heel = generator.uniform(0.0, 0.12) * np.clip(1.0 - along / 0.45, 0.0, 1.0)
    curl = generator.uniform(0.0, 0.08) * np.clip((along - 0.7) / 0.3, 0.0, 1.0) ** 2
    turn = 2 * np.pi * np.arange(28) / 28
    y = _power(np.cos(turn), 0.7)
    z = np.where(np.sin(turn) < 0, _power(np.sin(turn), 0.25), _power(np.sin(turn), 0.9))
    points = np.zeros((24, 28, 3))
    points[..., 0] = along[:, None]
    points[..., 1] = (width * blunt)[:, None] * y
    height = (0.5 * (z + 1.0)) * (top * (0.35 + 0.65 * blunt))[:, None]
    hollow = np.exp(-(((along - 0.22) / 0.16) ** 4))[:, None] * np.clip(z, 0.0, 1.0) ** 4 * (1 - np.abs(y) ** 3)
    # The upper narrows towards the opening.
    points[..., 1] *= 1.0 - 0.3 * np.clip((height - 0.15) / 0.4, 0.0, 1.0)
    points[..., 2] = height * (1.0 - 0.6 * hollow) + (heel + curl)[:, None]
    points[0, :, 1:], points[-1, :, 1:] = points[0, :, 1:].mean(axis=0), points[-1, :, 1:].mean(axis=0)
    return grid_mesh(points)


def animal(generator: np.random.Generator) -> Mesh:
    """A four-legged or sitting toy animal of blended bodies, looking along +x."""
    long, wide, high = generator.uniform([0.45, 0.26, 0.26], [0.75, 0.42, 0.42])
    head = generator.uniform(0.2, 0.34)
    front = np.array([long * generator.uniform(0.8, 1.1), 0.0, high * generator.uniform(0.6, 2.0)])
    parts: list[Distance] = [
        ellipsoid((0, 0, 0), (long, wide, high)),
        limb((0.5 * long, 0, 0), front, 0.8 * min(wide, high), 0.75 * head),
        ellipsoid(front, (1.1 * head, head, head)),
        ellipsoid(front + [head, 0, -0.2 * head], (generator.uniform(0.4, 1.1) * head, 0.6 * head, 0.5 * head)),
    ]
    leg, foot = generator.uniform(0.1, 0.17), -high - generator.uniform(0.15, 0.5)
    for x in (-0.65 * long, 0.6 * long):
        parts.append(mirrored(limb((x, 0.6 * wide, -0.3 * high), (x, 0.65 * wide, foot), 1.2 * leg, leg)))
    ear = generator.uniform([0.1, 0.1, 0.12], [0.15, 0.2, 0.4])
    parts.append(mirrored(ellipsoid(front + [-0.1, 0.7 * head, 0.8 * head], ear)))
    tail = np.array([-long, 0.0, 0.1])
    parts.append(limb(tail, tail + generator.uniform([-0.5, 0, -0.2], [-0.05, 0, 0.5]), 0.11, 0.1))
    reach = long + 2.4 * head + 0.2
    low = [-long - 0.8, -max(wide, head) - 0.45, foot - 0.4]
    high_corner = [max(reach, front[0] + 2.4 * head), -low[1], max(high, front[2] + head) + 0.75]
    mesh = surface(union(parts, generator.uniform(0.08, 0.2)), low, high_corner, 0.125)
    return _wrapped(mesh.normalized())


def _wrapped(mesh: Mesh) -> Mesh:
    """Give a mesh the texture coordinates of a sphere around its middle; the seam's faces get vertices of their own."""
    x, y, z = mesh.vertices.T
    texcoords = np.stack(
        [np.arctan2(y, x) / (2 * np.pi) + 0.5, 0.5 + z / max(2 * float(np.abs(z).max()), 1e-9)], axis=1
    )
    u = texcoords[mesh.faces, 0]
    behind = (np.ptp(u, axis=1) > 0.5)[:, None] & (u < 0.5)
    moved = np.unique(mesh.faces[behind])
    number = np.zeros(len(mesh.vertices), dtype=np.int32)
    number[moved] = len(mesh.vertices) + np.arange(len(moved))
    return Mesh(
        np.concatenate([mesh.vertices, mesh.vertices[moved]]),
        np.where(behind, number[mesh.faces], mesh.faces).astype(np.int32),
        np.concatenate([texcoords, texcoords[moved] + [1.0, 0.0]]),
    ).without_strays()


def _vessel(radii: NDArray[np.float64], tall: float, wall: float) -> list[tuple[float, float]]:
    """Profile of an open vessel: up its outside, over the rim, down its inside."""
    share = np.linspace(0.0, 1.0, 11)
    outside, height = _smooth(radii, share), tall * share
    inside = np.maximum(outside - wall, 0.3 * outside)
    up = list(zip(outside, height, strict=True))
    rim = [(float(outside[-1] + inside[-1]) / 2, tall + 0.3 * wall)]
    down = [(float(r), max(float(z), wall)) for r, z in zip(inside[::-1], height[::-1], strict=True) if z > wall]
    floor = float(np.interp(wall, height, inside))
    return [(0.0, 0.0), (0.9 * float(outside[0]), 0.0), *up[:1], *up[1:], *rim, *down, (floor * 0.9, wall), (0.0, wall)]


def _smooth(values: NDArray[np.float64], share: NDArray[np.float64]) -> NDArray[np.float64]:
    """Read evenly spaced values at places 0 to 1, without overshooting."""
    from scipy.interpolate import PchipInterpolator

    return np.asarray(PchipInterpolator(np.linspace(0.0, 1.0, len(values)), values)(share))


def _power(values: NDArray[np.float64], exponent: float) -> NDArray[np.float64]:
    return np.sign(values) * np.abs(values) ** exponent


def _box_ticks(half: float, round_off: float) -> NDArray[np.float64]:
    """Where a box's face is cut: at the rounded edge finely, over the flat middle coarsely."""
    edge = round_off * np.array([0.0, 0.42, 0.75, 1.0])
    flat = np.linspace(round_off - half, half - round_off, 4)[1:-1]
    return np.concatenate([-half + edge, flat, half - edge[::-1]])
