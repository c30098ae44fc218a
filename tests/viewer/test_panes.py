"""Panes side by side: where they stand, what a click hits, what is tinted."""

import numpy as np
import pytest

from vpd_lightning.viewer.panes import GROUND, SELECTED, compose, lay_out, tinted


@pytest.mark.parametrize(("height", "width"), [(400, 1200), (1200, 400), (300, 300), (64, 64)])
@pytest.mark.parametrize(("count", "aspect"), [(1, 1.0), (2, 0.7), (3, 1.5)])
def test_panes_do_not_overlap_and_a_place_is_found_in_the_pane_that_shows_it(
    height: int, width: int, count: int, aspect: float
) -> None:
    layout = lay_out(count, aspect, height, width)
    colors = [(255, 0, 0), (0, 255, 0), (0, 0, 255)][:count]
    images = [np.full((20, round(20 * aspect), 3), color, np.uint8) for color in colors]
    canvas = compose(layout, images, ["a", "b", "c"][:count])
    assert canvas.shape == (height, width, 3)
    seen = set()
    for row in range(0, height, 3):
        for column in range(0, width, 3):
            found = layout.find((column + 0.5) / width, (row + 0.5) / height)
            if found is None:
                assert tuple(canvas[row, column]) not in colors
                continue
            number, u, v = found
            assert tuple(canvas[row, column]) == colors[number] and 0 <= u < 1 and 0 <= v < 1
            seen.add(number)
    assert seen == set(range(count))
    assert layout.pane_width == pytest.approx(aspect * layout.pane_height, abs=1)


def test_wide_canvases_hold_panes_in_a_row_and_tall_ones_in_a_column() -> None:
    row, column = lay_out(3, 1.0, 400, 1200), lay_out(3, 1.0, 1200, 400)
    assert len({top for top, _ in row.corners}) == 1 and len({left for _, left in column.corners}) == 1


def test_a_place_in_a_pane_is_that_of_the_picture() -> None:
    layout = lay_out(2, 1.0, 500, 1000)
    image = np.zeros((10, 10, 3), np.uint8)
    image[2, 7] = 255
    canvas = compose(layout, [np.zeros_like(image), image], ["", ""])
    top, left = layout.corners[1]
    rows, columns = np.nonzero(canvas[top:, left:, 0] > 200)
    number, u, v = layout.find((columns.mean() + left + 0.5) / 1000, (rows.mean() + top + 0.5) / 500)  # type: ignore[misc]
    assert number == 1 and u == pytest.approx(0.75, abs=0.02) and v == pytest.approx(0.25, abs=0.02)


def test_what_is_selected_is_tinted_and_nothing_else() -> None:
    image = np.full((40, 60, 3), 100, np.uint8)
    marked = tinted(image, np.array([[30.0, 20.0], [500.0, 20.0]]), 4.0)
    changed = (marked != image).any(axis=-1)
    rows, columns = np.nonzero(changed)
    assert changed[20, 30] and abs(rows - 20).max() <= 4 and abs(columns - 30).max() <= 4
    assert tuple(marked[20, 34]) == SELECTED and image[20, 30, 0] == 100
    assert GROUND == 24
