"""Resized images against bilinear interpolation written out."""

import numpy as np
import pytest
import torch

from vpd_lightning.geometry.resizing import resize_images


def reference(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """Bilinear interpolation of pixel centres, the border repeated, in float64."""
    result = np.empty((height, width, 3))
    for row in range(height):
        y = min(max((row + 0.5) * image.shape[0] / height - 0.5, 0.0), image.shape[0] - 1.0)
        for column in range(width):
            x = min(max((column + 0.5) * image.shape[1] / width - 0.5, 0.0), image.shape[1] - 1.0)
            top, left = int(y), int(x)
            bottom, right = min(top + 1, image.shape[0] - 1), min(left + 1, image.shape[1] - 1)
            above = (1 - (x - left)) * image[top, left] + (x - left) * image[top, right]
            below = (1 - (x - left)) * image[bottom, left] + (x - left) * image[bottom, right]
            result[row, column] = (1 - (y - top)) * above + (y - top) * below
    return result


@pytest.mark.parametrize("size", [4, 16, (6, 9), (24, 10)])
def test_agrees_with_bilinear_interpolation(size: int | tuple[int, int]) -> None:
    image = torch.rand(12, 10, 3, dtype=torch.float64)
    height, width = size if isinstance(size, tuple) else (size, size)
    resized = resize_images(image, size)
    np.testing.assert_allclose(resized.numpy(), reference(image.numpy(), height, width), atol=1e-12)


def test_half_the_size_is_the_mean_of_four_pixels_rounded() -> None:
    images = torch.randint(0, 256, (2, 3, 8, 8, 3), dtype=torch.uint8)
    halves = resize_images(images, 4)
    assert halves.dtype == torch.uint8 and halves.shape == (2, 3, 4, 4, 3)
    means = images.double().reshape(2, 3, 4, 2, 4, 2, 3).mean(dim=(3, 5))
    assert (halves.double() - means).abs().max() <= 0.5


def test_images_of_the_size_are_left_alone() -> None:
    images = torch.randint(0, 256, (2, 8, 8, 3), dtype=torch.uint8)
    assert resize_images(images, 8) is images


def test_a_stack_is_resized_image_by_image() -> None:
    images = torch.rand(3, 8, 8, 3)
    alone = torch.stack([resize_images(image, 5) for image in images])
    torch.testing.assert_close(resize_images(images, 5), alone, rtol=0, atol=1e-6)
