"""Points followed in pictures: against plain loops, and where depth alone is too noisy."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from tests.dynamics.test_first_velocity import first_velocity, one_body, surfels
from tests.dynamics.test_inertial import dynamics
from vpd_lightning.dynamics.inertial.picture_match import chromaticity, picture_match
from vpd_lightning.geometry.cameras import pixel_rays, project
from vpd_lightning.randomness import RandomKeys
from vpd_lightning.types import Cameras, Particles, Pictures

SIZE = 24


def looking(eye, at):
    """Return the pose of a camera: x right, y down, z towards ``at``."""
    forward = torch.nn.functional.normalize(torch.tensor(at).double() - torch.tensor(eye).double(), dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(torch.tensor([0.0, 0.3, -1.0]).double(), forward), dim=0)
    down = torch.linalg.cross(forward, right)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.stack([right, down, forward], dim=1)
    pose[:3, 3] = torch.tensor(eye)
    return pose


def two_cameras():
    matrix = torch.tensor([[30.0, 0.4, 12.5], [0.0, 28.0, 11.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    poses = torch.stack([looking([0.0, -2.0, 1.0], [0.1, 0.0, 0.0]), looking([1.5, -1.4, 0.8], [0.0, 0.0, 0.1])])
    return Cameras(matrix.expand(1, 2, 3, 3), poses[None], SIZE, SIZE)


def random_frames(seed, count=40):
    """Points near the origin that both cameras measure, and pictures of noise."""
    generator = torch.Generator().manual_seed(seed)
    points = 0.3 * torch.randn(1, count, 3, generator=generator, dtype=torch.float64)
    cameras, frames = two_cameras(), []
    for _ in range(2):
        rgb = torch.rand(1, 2, SIZE, SIZE, 3, generator=generator, dtype=torch.float64)
        depth = torch.full((1, 2, SIZE, SIZE), 2.0, dtype=torch.float64)
        frames.append(
            Particles(
                positions=points,
                features=torch.zeros(1, count, 2, dtype=torch.float64),
                pixels=torch.arange(count)[None],
                pictures=Pictures(rgb, depth, cameras),
            )
        )
    return frames


def plain_picture(rgb):
    compared = np.concatenate([rgb / (rgb.sum(-1, keepdims=True) + 0.15), 0.3 * rgb], axis=-1)
    return gaussian_filter(compared, 0.8, radius=2, mode="nearest", axes=(0, 1))


def plain_value(image, x, y):
    """Bilinear, pixel centres at +0.5; the border goes on."""
    height, width = image.shape[:2]
    column, row = int(np.floor(x - 0.5)), int(np.floor(y - 0.5))
    right, below = x - 0.5 - column, y - 0.5 - row
    total = 0.0
    for j, share_y in ((row, 1 - below), (row + 1, below)):
        for i, share_x in ((column, 1 - right), (column + 1, right)):
            total = total + share_x * share_y * image[min(max(j, 0), height - 1), min(max(i, 0), width - 1)]
    return total


def plain_slopes(image):
    wide = np.pad(image, ((1, 1), (1, 1), (0, 0)), mode="edge")
    return (wide[1:-1, 2:] - wide[1:-1, :-2]) / 2, (wide[2:, 1:-1] - wide[:-2, 1:-1]) / 2


def plain_pixel(point, camera):
    pixel, depth = project(torch.from_numpy(point), camera)
    return pixel.numpy(), float(depth)


def plain_equations(previous, current, places, spacing):
    """One point and one view at a time; how pixels move by finite differences of the projection."""
    matrices, rights = [], []
    for number, place in enumerate(places):
        matrix, right = np.zeros((3, 3)), np.zeros(3)
        for view in range(2):
            camera = current.pictures.cameras[0, view]
            now, before = (plain_picture(frame.pictures.rgb[0, view].numpy()) for frame in (current, previous))
            pixel, depth = plain_pixel(current.positions[0, number].numpy(), camera)
            was, was_depth = plain_pixel(place, camera)
            inside = all(0 < value < SIZE for value in (*pixel, *was)) and depth > 0 and was_depth > 0
            if not inside or abs(depth - 2.0) > 2 * spacing:
                continue
            change = plain_value(before, *was) - plain_value(now, *pixel)
            slopes = [
                (plain_value(one, *was) + plain_value(other, *pixel)) / 2
                for one, other in zip(plain_slopes(before), plain_slopes(now), strict=True)
            ]
            jacobian = np.zeros((6, 3))
            for axis in range(3):
                step = np.zeros(3)
                step[axis] = 1e-6
                ahead, behind = plain_pixel(place + step, camera)[0], plain_pixel(place - step, camera)[0]
                by = (ahead - behind) / 2e-6
                jacobian[:, axis] = slopes[0] * by[0] + slopes[1] * by[1]
            weight = 1 / (1 + (change**2).sum() / 0.15**2) ** 2
            matrix += weight * jacobian.T @ jacobian
            right -= weight * jacobian.T @ change
        matrices.append(matrix)
        rights.append(right)
    return np.array(matrices), np.array(rights)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_equations_are_those_of_plain_loops(seed):
    previous, current = random_frames(seed)
    index, spacing = torch.arange(40)[None], 0.15
    generator = torch.Generator().manual_seed(20 + seed)
    places = current.positions + 0.05 * torch.randn(1, 40, 3, generator=generator, dtype=torch.float64)
    pictures = picture_match(previous, current, index, torch.tensor([spacing], dtype=torch.float64))
    matrix, right = pictures.equations(places)
    plain_matrix, plain_right = plain_equations(previous, current, places[0].numpy(), spacing)
    assert np.abs(plain_right).max(axis=1).astype(bool).sum() > 20, "hardly any point is seen"
    np.testing.assert_allclose(matrix[0].numpy(), plain_matrix, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(right[0].numpy(), plain_right, rtol=1e-6, atol=1e-8)
    some = pictures.first(7).equations(places[:, :7])
    torch.testing.assert_close(some[0], matrix[:, :7])


def test_what_pictures_do_not_show_tells_nothing():
    previous, current = random_frames(0)
    index, spacing = torch.arange(40)[None], torch.tensor([0.15], dtype=torch.float64)
    whole = picture_match(previous, current, index, spacing).equations(current.positions)[0]
    pixels = current.pixels.clone()
    pixels[:, ::2] = -1  # put there by hand
    half = picture_match(previous, replace(current, pixels=pixels), index, spacing).equations(current.positions)[0]
    assert (half[:, ::2] == 0).all() and torch.equal(half[:, 1::2], whole[:, 1::2]) and whole.any()
    hidden = replace(current.pictures, depth=torch.full_like(current.pictures.depth, 1.2))
    assert not picture_match(previous, replace(current, pictures=hidden), index, spacing).seen.any()
    unmeasured = replace(current.pictures, depth=torch.zeros_like(current.pictures.depth))
    assert not picture_match(previous, replace(current, pictures=unmeasured), index, spacing).seen.any()
    gone = picture_match(previous, current, index, spacing).equations(current.positions + 100.0)
    assert not gone[0].any() and not gone[1].any() and gone[0].isfinite().all()


@pytest.mark.parametrize("lacking", ["pixels", "pictures", "previous"])
def test_without_pictures_there_is_no_match(lacking):
    previous, current = random_frames(0)
    if lacking == "previous":
        previous = replace(previous, pictures=None)
    else:
        current = replace(current, **{lacking: None})
    assert picture_match(previous, current, torch.arange(40)[None], torch.ones(1, dtype=torch.float64)) is None


def painted_board(shift, noise, seed, size=48):
    """A board of smooth colours before a grey wall, seen from 2 m: its pixels' points, with the camera's noise."""
    generator = torch.Generator().manual_seed(seed)
    matrix = torch.tensor([[size * 1.1, 0.0, size / 2], [0.0, size * 1.1, size / 2], [0.0, 0.0, 1.0]]).double()
    camera = Cameras(matrix[None, None], torch.eye(4).double()[None, None], size, size)
    rays = pixel_rays(camera)
    distance = 2.0 + shift[2]
    rgb, board = torch.zeros(size, size, 3).double(), torch.zeros(size, size).bool()
    for part in range(16):  # 16 rays a pixel, as an area of colour would be seen
        offset = torch.tensor([(part % 4 + 0.5) / 4 - 0.5, (part // 4 + 0.5) / 4 - 0.5]).double() / (size * 1.1)
        directions = rays.directions[0, 0] / rays.directions[0, 0, ..., 2:]
        place = (directions[..., :2] + offset) * distance - torch.tensor(shift[:2]).double()
        inside = (place.abs() < 0.25).all(dim=-1)
        waves = torch.stack(
            [torch.sin(9 * place[..., 0]), torch.sin(7 * place[..., 1] + 1), torch.cos(8 * place.sum(-1))]
        )
        rgb += torch.where(inside[..., None], 0.5 + 0.4 * waves.movedim(0, -1), 0.5) / 16
        board = inside if part == 5 else board  # depth is that of one ray near the middle
    depth = torch.where(board, distance, 3.0) * (1 + noise * torch.randn(size, size, generator=generator).double())
    directions = rays.directions[0, 0] / rays.directions[0, 0, ..., 2:]
    points = (directions * depth[..., None])[board]
    normals = torch.tensor([0.0, 0.0, -1.0]).double().expand(len(points), 3)
    return Particles(
        positions=points[None],
        features=torch.zeros(1, len(points), 2).double(),
        colors=rgb[board][None],
        normals=normals[None],
        pixels=board.flatten().nonzero().T,
        pictures=Pictures(rgb[None, None], depth[None, None], camera),
    )


def test_pictures_tell_a_shift_across_the_ray_to_a_tenth_of_a_pixel():
    pixel = 2.0 / (48 * 1.1)
    errors = {0.0: [], 3.0: []}
    for seed in range(4):
        shift = torch.tensor([[0.6, 0.3, 0.0], [-0.4, 0.9, 0.2], [1.3, -0.2, 0.1], [0.2, 0.2, -0.3]][seed]) * pixel
        previous, current = painted_board([0, 0, 0], 0.005, seed), painted_board(shift.tolist(), 0.005, 10 + seed)
        match = picture_match(
            previous, current, torch.arange(len(current.positions[0]))[None], torch.tensor([0.06]).double()
        )
        now, before = (surfels(part.positions[0], part.colors[0], part.normals[0]) for part in (current, previous))
        for weight, found in errors.items():
            model = first_velocity(picture_weight=weight, num_matched=1000)
            displacement = model(now, one_body(now), before, match).displacements[0].mean(dim=0)
            found.append((displacement - shift)[:2].norm() / pixel)
    alone, together = (float(torch.stack(found).mean()) for found in errors.values())
    assert together < 0.1 and together < 0.6 * alone, (alone, together)


def test_brightness_counts_less_than_colour():
    grey, red = torch.tensor([[0.4, 0.4, 0.4]]), torch.tensor([[0.6, 0.3, 0.3]])
    darker = chromaticity(grey) - chromaticity(0.8 * grey)
    assert darker.norm() < 0.5 * (chromaticity(grey) - chromaticity(red)).norm()


def test_a_rollout_carries_no_pictures_on():
    """Predicted particles are not where the pictures show them, and a memory rebuilt from them must not look there."""
    previous, current = (replace(frame, colors=frame.positions, normals=frame.positions) for frame in random_frames(0))
    model = dynamics(feature_dim=2, carry_memory=False).double().eval()
    keys = RandomKeys.fixed(1)
    moving = torch.ones(1, 40, dtype=torch.bool)
    previous, current = (replace(frame, moving=moving) for frame in (previous, current))

    with torch.no_grad():
        memory = model.initialize(previous, current, keys)
        following, memory = model(previous, current, memory, keys, 0)
        last, _ = model(current, following, memory, keys, 1)

    assert following.pixels is None and following.pictures is None and last.positions.isfinite().all()
