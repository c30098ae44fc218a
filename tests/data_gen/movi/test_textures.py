import numpy as np
import pytest

from data_gen.movi import textures


def seams(image: np.ndarray, axis: int) -> tuple[float, float]:
    """Mean step of colour across the border of a picture laid side by side, and inside of it."""
    values = image.astype(float)
    inside = np.abs(np.diff(values, axis=axis)).mean(axis=tuple(i for i in range(3) if i != axis))
    border = np.abs(np.take(values, 0, axis=axis) - np.take(values, -1, axis=axis)).mean()
    return float(border), float(inside.max())


def test_value_noise_fills_its_range_and_repeats():
    noise = textures.value_noise(np.random.default_rng(0), 64, 96, 6, 4)
    assert noise.shape == (64, 96)
    assert noise.min() == 0.0 and noise.max() == 1.0
    wide = np.tile(noise, (2, 2))
    # Nothing at the border is steeper than what is inside.
    assert np.abs(np.diff(wide, axis=0)).max() == pytest.approx(np.abs(np.diff(noise, axis=0)).max(), rel=0.5)
    assert np.abs(np.diff(wide, axis=1)).max() == pytest.approx(np.abs(np.diff(noise, axis=1)).max(), rel=0.5)


def test_floors_can_be_laid_side_by_side():
    for seed in range(12):
        image = textures.floor_texture(np.random.default_rng(seed), size=128)
        assert image.dtype == np.uint8 and image.shape == (128, 128, 3)
        for axis in (0, 1):
            border, steepest = seams(image, axis)
            assert border <= 1.2 * steepest + 2, seed  # a joint between tiles may lie on the border


def test_panorama_closes_around_and_differs_from_bottom_to_top():
    for seed in range(8):
        image = textures.panorama_texture(np.random.default_rng(seed))
        assert image.shape == (256, 1024, 3) and image.dtype == np.uint8
        border, steepest = seams(image, 1)
        assert border <= 1.2 * steepest + 2, seed
        assert np.abs(image[-1].mean(axis=0) - image[100].mean(axis=0)).max() > 10, seed


def test_object_textures_are_pictures_of_their_generator():
    for seed in range(20):
        first = textures.object_texture(np.random.default_rng(seed))
        assert first.shape == (128, 128, 3) and first.dtype == np.uint8
        assert np.array_equal(first, textures.object_texture(np.random.default_rng(seed)))
        assert not np.array_equal(first, textures.object_texture(np.random.default_rng(seed + 1)))
    assert textures.package_texture(np.random.default_rng(0)).shape == (128, 128, 3)


def test_six_faces_of_a_package_are_printed_differently():
    image = textures.package_texture(np.random.default_rng(4), size=120)
    faces = [image[y : y + 60, x : x + 40].tobytes() for y in (0, 60) for x in (0, 40, 80)]
    assert len(set(faces)) == 6
