"""Pictures for objects, floor and horizon of the MOVi-C-like scenes, all from a random generator.

Everything is sRGB uint8 (height, width, 3), row 0 at the top. These stand in for scanned textures and for the
high-dynamic-range panoramas of Kubric's MOVi-C, which are not shipped here.
"""

import colorsys
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

OBJECT_SIZE = 128  # pixels, side of an object's texture
FLOOR_SIZE = 512
PANORAMA_HEIGHT, PANORAMA_WIDTH = 256, 1024


def value_noise(
    generator: np.random.Generator, height: int, width: int, cells: int, octaves: int, aspect: float = 1.0
) -> Array:
    """Smooth noise (height, width) in [0, 1] that repeats in both directions.

    ``cells`` random values across the width in the first octave (``cells * aspect`` over the height); each further
    octave has twice as many and half the weight.
    """
    total, weights = np.zeros((height, width)), 0.0
    for octave in range(octaves):
        across = min(cells * 2**octave, width)
        down = min(max(1, round(cells * aspect)) * 2**octave, height)
        lattice = generator.random((down, across))
        total += _between(height, down) @ lattice @ _between(width, across).T / 2**octave
        weights += 0.5**octave
    spread = float(np.ptp(total))
    return (total - total.min()) / (spread if spread > 0 else 1.0)


def object_texture(generator: np.random.Generator, size: int = OBJECT_SIZE) -> NDArray[np.uint8]:
    """Return a random object's texture: one of seven patterns in a palette of four colours, worn a little."""
    palette = random_palette(generator)
    pattern = _PATTERNS[int(generator.integers(len(_PATTERNS)))]
    image = pattern(generator, size, palette)
    wear = value_noise(generator, size, size, 4, 4)
    return to_bytes(image * (1.0 - 0.25 * generator.random() * wear[..., None]))


def package_texture(generator: np.random.Generator, size: int = OBJECT_SIZE) -> NDArray[np.uint8]:
    """Return six printed faces of a package, in three columns and two rows."""
    palette = random_palette(generator)
    columns, rows = np.linspace(0, size, 4).astype(int), np.linspace(0, size, 3).astype(int)
    image = np.zeros((size, size, 3))
    for row in range(2):
        for column in range(3):
            part = image[rows[row] : rows[row + 1], columns[column] : columns[column + 1]]
            part[:] = _label(generator, max(part.shape[:2]), palette)[: part.shape[0], : part.shape[1]]
    wear = value_noise(generator, size, size, 6, 3)
    return to_bytes(image * (1.0 - 0.15 * wear[..., None]))


def floor_texture(generator: np.random.Generator, size: int = FLOOR_SIZE) -> NDArray[np.uint8]:
    """Return a floor that can be laid side by side: ground, planks, slabs, tiles or carpet."""
    kind = _FLOORS[int(generator.integers(len(_FLOORS)))]
    image = kind(generator, size)
    grain = value_noise(generator, size, size, size // 4, 2) - 0.5
    return to_bytes(image + 0.12 * grain[..., None])


def panorama_texture(
    generator: np.random.Generator, height: int = PANORAMA_HEIGHT, width: int = PANORAMA_WIDTH
) -> NDArray[np.uint8]:
    """Return the surrounding of a scene: left to right once around, the bottom row on the horizon, the top overhead.

    Outdoors a sky with clouds over hills, trees or houses; indoors a hall with walls, windows and a ceiling. Left and
    right border fit together.
    """
    up = (1.0 - (np.arange(height) + 0.5) / height)[:, None] * np.ones(width)  # 0 on the horizon, 1 overhead
    image = _hall(generator, up) if generator.random() < 0.35 else _outdoors(generator, up)
    return to_bytes(image)


def random_palette(generator: np.random.Generator) -> Array:
    """Four sRGB colours (4, 3) in [0, 1] that go together: ground, accent, light and dark."""
    hue, saturation = generator.random(), generator.uniform(0.15, 0.9)
    other = hue + generator.choice([0.08, -0.08, 0.33, 0.5, 0.58])
    return np.array(
        [
            _hsv(hue, saturation, generator.uniform(0.45, 0.95)),
            _hsv(other, generator.uniform(0.4, 0.95), generator.uniform(0.5, 0.95)),
            _hsv(hue, 0.12 * generator.random(), generator.uniform(0.85, 1.0)),
            _hsv(other, 0.5 * generator.random(), generator.uniform(0.08, 0.3)),
        ]
    )


def to_bytes(image: Array) -> NDArray[np.uint8]:
    """Round colours in [0, 1] to sRGB uint8."""
    return np.rint(255.0 * np.clip(image, 0.0, 1.0)).astype(np.uint8)


def _hsv(hue: float, saturation: float, value: float) -> Array:
    return np.array(colorsys.hsv_to_rgb(float(hue) % 1.0, float(saturation), float(value)))


def _between(count: int, cells: int) -> Array:
    """(count, cells): weights that read a ring of ``cells`` values at ``count`` even places, smoothly."""
    place = (np.arange(count) + 0.5) * cells / count
    cell = np.floor(place).astype(int)
    share = place - cell
    share = share * share * (3.0 - 2.0 * share)
    weights = np.zeros((count, cells))
    np.add.at(weights, (np.arange(count), cell % cells), 1.0 - share)
    np.add.at(weights, (np.arange(count), (cell + 1) % cells), share)
    return weights


def _grid(size: int) -> tuple[Array, Array]:
    axis = (np.arange(size) + 0.5) / size
    u, v = np.meshgrid(axis, axis)
    return u, v


def _mix(first: Array, second: Array, share: Array) -> Array:
    return first + (second - first) * share[..., None]


def _stripes(generator: np.random.Generator, size: int, palette: Array) -> Array:
    u, v = _grid(size)
    across, along = int(generator.integers(0, 5)), int(generator.integers(2, 9))
    wave = (u * across + v * along) % 1.0
    image = _mix(palette[0], palette[1], (wave < generator.uniform(0.2, 0.6)).astype(float))
    thin = np.abs(wave - 0.8) < 0.06
    return _mix(image, palette[2], thin.astype(float))


def _dots(generator: np.random.Generator, size: int, palette: Array) -> Array:
    u, v = _grid(size)
    count = int(generator.integers(3, 8))
    row = np.floor(v * 2 * count)
    x, y = (u * count + 0.5 * (row % 2)) % 1.0 - 0.5, ((v * 2 * count) % 1.0 - 0.5) / 2
    dot = np.hypot(x, y) < generator.uniform(0.12, 0.24)
    return _mix(palette[0], palette[1 + int(generator.integers(2))], dot.astype(float))


def _checks(generator: np.random.Generator, size: int, palette: Array) -> Array:
    u, v = _grid(size)
    count = int(generator.integers(2, 7))
    odd = (np.floor(u * 2 * count) + np.floor(v * 2 * count)) % 2
    band = (np.floor(v * count) % 2) * 0.5
    return _mix(_mix(palette[0], palette[2], odd), palette[1], band * (1 - odd))


def _marble(generator: np.random.Generator, size: int, palette: Array) -> Array:
    noise = value_noise(generator, size, size, int(generator.integers(2, 6)), 5)
    veins = np.abs(np.sin(2 * np.pi * (1.5 * noise + 0.5)))
    return _mix(_mix(palette[0], palette[1], noise), palette[3], np.where(veins < 0.16, 0.8, 0.0))


def _camouflage(generator: np.random.Generator, size: int, palette: Array) -> Array:
    noise = value_noise(generator, size, size, int(generator.integers(3, 7)), 3)
    order = generator.permutation(4)
    steps = np.digitize(noise, np.quantile(noise, [0.35, 0.6, 0.85]))
    return palette[order][steps]


def _printed(generator: np.random.Generator, size: int, palette: Array) -> Array:
    """A plain body with a printed band around its middle."""
    u, v = _grid(size)
    low, high = generator.uniform(0.1, 0.35), generator.uniform(0.6, 0.9)
    image = np.where(((v > low) & (v < high))[..., None], _label(generator, size, palette), palette[1])
    edge = (np.abs(v - low) < 0.015) | (np.abs(v - high) < 0.015)
    return _mix(image, palette[3], edge.astype(float))


def _patches(generator: np.random.Generator, size: int, palette: Array) -> Array:
    """Panels of different colours, as sewn or painted."""
    cells = generator.random((int(generator.integers(5, 12)), 2))
    u, v = _grid(size)
    across = np.abs(u[..., None] - cells[:, 0])
    distance = np.hypot(np.minimum(across, 1 - across), v[..., None] - cells[:, 1])
    order = np.sort(distance, axis=-1)
    image = palette[generator.integers(0, 4, len(cells))][np.argmin(distance, axis=-1)]
    return _mix(image, palette[3], 0.7 * (order[..., 1] - order[..., 0] < 0.02))


def _label(generator: np.random.Generator, size: int, palette: Array) -> Array:
    """A printed label: ground, a big shape, a headline and lines of "text"."""
    image = np.broadcast_to(palette[int(generator.choice([0, 0, 2]))], (size, size, 3)).copy()
    u, v = _grid(size)
    x, y, radius = generator.uniform(0.1, 0.6), generator.uniform(0.2, 0.7), generator.uniform(0.12, 0.3)
    shape = np.hypot(u - x, v - y) < radius if generator.random() < 0.5 else np.maximum(abs(u - x), abs(v - y)) < radius
    image[shape] = palette[1]
    top = int(size * generator.uniform(0.08, 0.25))
    image[top : top + size // 7, : int(size * generator.uniform(0.4, 0.9))] = palette[3]
    rows = range(int(size * 0.55), int(size * 0.85), max(3, size // 24))
    for row in rows:
        words = np.repeat(generator.random(size // 4 + 1) < 0.7, 4)[:size]
        words[int(size * 0.6) :] = False
        image[row : row + max(1, size // 64), words] = palette[3]
    return image


_PATTERNS: tuple[Callable[[np.random.Generator, int, Array], Array], ...] = (
    _stripes, _dots, _checks, _marble, _camouflage, _printed, _patches,
)  # fmt: skip


def _ground(generator: np.random.Generator, size: int) -> Array:
    hue = generator.choice([0.08, 0.1, 0.22, 0.3])
    low, high = _hsv(hue, 0.45, 0.25), _hsv(hue + 0.03, 0.35, 0.62)
    image = _mix(low, high, value_noise(generator, size, size, 6, 6))
    stones = value_noise(generator, size, size, 48, 2)
    return _mix(image, _hsv(0.1, 0.1, 0.7), np.where(stones > 0.8, 0.7, 0.0))


def _planks(generator: np.random.Generator, size: int) -> Array:
    count = int(generator.choice([8, 16]))
    hue, value = generator.uniform(0.04, 0.11), generator.uniform(0.35, 0.75)
    u, v = _grid(size)
    plank = np.floor(v * count).astype(int)
    shift = generator.random(count)[plank]
    board = np.floor((u + shift) * 2).astype(int) % 2
    tone = generator.uniform(0.75, 1.1, (count, 2))[plank, board]
    fibre = value_noise(generator, size, size, 4, 3, aspect=24.0)
    image = _hsv(hue, 0.5, value) * (tone * (0.75 + 0.4 * fibre))[..., None]
    gap = ((v * count) % 1.0 < 0.05) | ((((u + shift) * 2) % 1.0) < 0.008)
    return _mix(image, 0.3 * image.mean(axis=(0, 1)), gap.astype(float))


def _slabs(generator: np.random.Generator, size: int) -> Array:
    count = int(generator.choice([4, 6, 8]))
    u, v = _grid(size)
    row, column = np.floor(v * count).astype(int), np.floor(u * count).astype(int)
    tone = generator.uniform(0.7, 1.1, (count, count))[row, column]
    stone = value_noise(generator, size, size, 8, 5)
    base = _hsv(generator.random(), generator.uniform(0.0, 0.2), generator.uniform(0.45, 0.75))
    image = base * (tone * (0.75 + 0.4 * stone))[..., None]
    x, y = (u * count) % 1.0, (v * count) % 1.0
    joint = np.minimum(np.minimum(x, 1 - x), np.minimum(y, 1 - y)) < 0.025
    return _mix(image, 0.45 * base, joint.astype(float))


def _tiles(generator: np.random.Generator, size: int) -> Array:
    count = int(generator.choice([4, 8]))
    u, v = _grid(size)
    odd = (np.floor(u * count) + np.floor(v * count)) % 2
    palette = random_palette(generator)
    image = _mix(0.75 * palette[0], palette[2], odd)
    return image * (0.85 + 0.2 * value_noise(generator, size, size, 8, 4))[..., None]


def _carpet(generator: np.random.Generator, size: int) -> Array:
    palette = random_palette(generator)
    noise = value_noise(generator, size, size, 5, 4)
    image = _mix(0.7 * palette[0], 0.8 * palette[1], 0.6 * noise)
    weave = 0.85 + 0.15 * generator.random((size, size))
    return image * weave[..., None]


_FLOORS: tuple[Callable[[np.random.Generator, int], Array], ...] = (_ground, _planks, _slabs, _tiles, _carpet)


def _outdoors(generator: np.random.Generator, up: Array) -> Array:
    height, width = up.shape
    hue, value = generator.uniform(0.54, 0.64), generator.uniform(0.6, 1.0)
    horizon = _hsv(generator.choice([0.08, 0.12, hue]), generator.uniform(0.05, 0.35), min(1.0, value + 0.1))
    image = _mix(horizon, _hsv(hue, generator.uniform(0.3, 0.65), value), np.clip(2.2 * up, 0, 1) ** 0.6)
    clouds = value_noise(generator, height, width, 12, 5, aspect=0.5)
    image = _mix(image, np.full(3, min(1.0, value + 0.08)), np.clip((clouds - generator.uniform(0.4, 0.7)) * 3, 0, 0.9))
    hills = 0.04 + 0.16 * generator.random() * value_noise(generator, 1, width, 6, 4)[0]
    far = up < hills
    image[far] = (0.55 * horizon + 0.45 * _hsv(generator.uniform(0.2, 0.6), 0.35, 0.4 * value))[None]
    near = _skyline(generator, width) if generator.random() < 0.4 else _treeline(generator, width)
    tone = _hsv(generator.choice([0.25, 0.3, 0.07, 0.6]), 0.3, 0.35 * value)
    shade = 0.7 + 0.6 * value_noise(generator, height, width, 64, 3, aspect=0.5)
    front = up < near
    image[front] = np.broadcast_to(tone, image.shape)[front] * shade[front][:, None]
    return image


def _treeline(generator: np.random.Generator, width: int) -> Array:
    base = value_noise(generator, 1, width, 16, 5)[0]
    return 0.03 + generator.uniform(0.1, 0.24) * base


def _skyline(generator: np.random.Generator, width: int) -> Array:
    """Heights of houses side by side."""
    count = int(generator.integers(24, 60))
    house = np.searchsorted(np.sort(generator.random(count - 1)), (np.arange(width) + 0.5) / width)
    return 0.04 + generator.uniform(0.12, 0.3) * generator.random(count)[house]


def _hall(generator: np.random.Generator, up: Array) -> Array:
    """Four walls with a skirting board, windows or panels, and a ceiling with lamps."""
    height, width = up.shape
    across = np.arange(width) / width * np.ones((height, 1))
    wall = _hsv(generator.random(), generator.uniform(0.05, 0.4), generator.uniform(0.55, 0.9))
    side = np.floor(across * 4).astype(int) % 4
    image = wall * generator.uniform(0.75, 1.05, 4)[side][..., None]
    # A straight wall's upper edge is highest in its middle, seen from the middle of the room.
    edge = generator.uniform(0.32, 0.5) * np.cos((across * 4 % 1.0 - 0.5) * np.pi / 2)
    count = int(generator.integers(4, 9)) * 4
    x = (across * count) % 1.0
    pane = (np.abs(x - 0.5) < generator.uniform(0.2, 0.4)) & (up > 0.25 * edge) & (up < 0.75 * edge)
    light = generator.random() < 0.6
    panel = _hsv(0.58, 0.15, 0.97) if light else _hsv(generator.random(), 0.5, 0.5)
    image[pane] = panel
    image[(np.abs(x - 0.5) < 0.02) & pane] = 0.5 * wall
    image[up < 0.08 * edge] = 0.4 * wall
    ceiling = up > edge
    image[ceiling] = np.full(3, generator.uniform(0.7, 0.92))
    lamps = ceiling & ((across * 12 % 1.0) < 0.3) & (np.abs((up * 8) % 1.0 - 0.5) < 0.12) & (up < 0.9)
    image[lamps] = 1.0
    plaster = 0.92 + 0.12 * value_noise(generator, height, width, 32, 4, aspect=0.5)
    return image * plaster[..., None]
