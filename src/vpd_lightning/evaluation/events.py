"""What happens to bodies: when they strike something, and whether they come to rest where they should."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from vpd_lightning.evaluation.statistics import plain
from vpd_lightning.metrics.body_dynamics import first_contact

_FALL_SPEED = 0.3  # m/s downwards; slower than that nothing counts as a fall
_REST_SPEED, _REST_STEPS = 0.05, 5  # m/s, and over how many last steps
_REST_HEIGHT = 0.05  # metres


def events_of(motion: Mapping[str, NDArray[np.float64]]) -> dict[str, Any] | None:
    """Summarise ``contact`` and ``rest`` over the bodies of all clips (axes ``clip object step``); None without bodies.

    ``contact`` is about the first step at which a body that fell (faster than 0.3 m/s) has lost half of its greatest
    downward speed: ``error`` is the mean difference in steps where truth and prediction have one, ``missed`` the share
    of true contacts that the prediction lacks within the clip, ``invented`` the share of bodies without one that are
    predicted to have one. ``rest`` is about bodies whose true speed is below 0.05 m/s over the last five steps: at the
    last one, the mean error of their lowest point (metres) and their predicted speed (m/s), both where the prediction
    is finite, and the share of all of them that is within 5 cm. Both ``count`` what the truth has.
    """
    if not motion:
        return None
    return {"contact": _contact(motion), "rest": _rest(motion)}


def _contact(motion: Mapping[str, NDArray[np.float64]]) -> dict[str, Any]:
    true, pred = (
        first_contact(torch.from_numpy(motion[name]), _FALL_SPEED).numpy()
        for name in ("true_vertical_velocity", "vertical_velocity")
    )
    known = np.isfinite(motion["true_vertical_velocity"]).all(-1)
    strikes, quiet = known & np.isfinite(true), known & ~np.isfinite(true)
    both = strikes & np.isfinite(pred)
    return {
        "error": _mean(np.abs(pred[both] - true[both])),
        "missed": _mean(~np.isfinite(pred[strikes])),
        "invented": _mean(np.isfinite(pred[quiet])),
        "count": int(strikes.sum()),
    }


def _rest(motion: Mapping[str, NDArray[np.float64]]) -> dict[str, Any]:
    error, speed, true_speed = (motion[name] for name in ("height_error", "speed", "true_speed"))
    resting = (true_speed[..., -_REST_STEPS:] < _REST_SPEED).all(-1) & (true_speed.shape[-1] >= _REST_STEPS)
    error, speed = error[..., -1][resting], speed[..., -1][resting]
    return {
        "height_error": _mean(error[np.isfinite(error)]),
        "share_within_5_cm": _mean(error <= _REST_HEIGHT),
        "speed": _mean(speed[np.isfinite(speed)]),
        "count": int(resting.sum()),
    }


def _mean(values: NDArray[Any]) -> float | None:
    return plain(values.mean()) if values.size else None
