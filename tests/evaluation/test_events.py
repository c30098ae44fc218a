"""Contact and rest over the bodies of all clips, from arrays whose figures are known."""

import numpy as np
import pytest
from numpy.typing import NDArray

from vpd_lightning.evaluation.events import events_of

FALL = np.array([-1.0, -1.5, -2.0, 0.1, 0.0, 0.0, 0.0, 0.0, 0.0])
EARLIER = np.array([-1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
FLYING = np.linspace(1.0, -3.0, 9)


def motion(true: list[NDArray], pred: list[NDArray], height_error: list[float]) -> dict[str, NDArray[np.float64]]:
    """One body in each of some clips; speeds are vertical."""
    true_velocity, velocity = np.stack(true)[:, None], np.stack(pred)[:, None]
    return {
        "true_vertical_velocity": true_velocity, "vertical_velocity": velocity,
        "true_speed": np.abs(true_velocity), "speed": np.abs(velocity) + 0.01,
        "height_error": np.broadcast_to(np.array(height_error)[:, None, None], velocity.shape),
    }  # fmt: skip


def test_contacts_are_early_missed_and_invented() -> None:
    events = events_of(motion([FALL, FALL, FALL, FLYING], [FALL, EARLIER, FLYING, FALL], [0.0] * 4))

    assert events is not None
    assert events["contact"] == {
        "error": pytest.approx(1.0),
        "missed": pytest.approx(1 / 3),
        "invented": 1.0,
        "count": 3,
    }


def test_rest_is_judged_where_the_true_body_rests() -> None:
    events = events_of(motion([FALL, FALL, FLYING], [FALL, FALL, FLYING], [0.02, 0.08, 5.0]))

    assert events is not None and events["rest"]["count"] == 2
    assert events["rest"]["height_error"] == pytest.approx(0.05)
    assert events["rest"]["share_within_5_cm"] == 0.5 and events["rest"]["speed"] == pytest.approx(0.01)


def test_a_prediction_that_is_not_finite_counts_against_the_system() -> None:
    late, early = FALL.copy(), FALL.copy()
    late[8], early[1:] = np.nan, np.nan
    events = events_of(motion([FALL, FALL], [late, early], [0.02, 0.02]))

    assert events is not None
    assert events["contact"] == {"error": 0.0, "missed": 0.5, "invented": None, "count": 2}
    gone = motion([FALL, FALL], [FALL, FALL], [0.02, np.nan])
    rest = events_of(gone)["rest"]  # type: ignore[index]
    assert rest["count"] == 2 and rest["share_within_5_cm"] == 0.5 and rest["height_error"] == pytest.approx(0.02)


def test_rest_takes_five_steps_to_show() -> None:
    short = {name: values[..., -4:] for name, values in motion([FALL], [FALL], [0.0]).items()}
    assert events_of(short)["rest"]["count"] == 0  # type: ignore[index]


def test_bodies_that_are_not_seen_do_not_count_and_no_bodies_have_no_events() -> None:
    unseen = np.full(9, np.nan)
    events = events_of(motion([unseen], [unseen], [np.nan]))

    assert events == {
        "contact": {"error": None, "missed": None, "invented": None, "count": 0},
        "rest": {"height_error": None, "share_within_5_cm": None, "speed": None, "count": 0},
    }
    assert events_of({}) is None
