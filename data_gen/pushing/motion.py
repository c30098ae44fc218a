"""Where the pusher is asked to be: pushes through a body's centre, or random ways over the table."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from data_gen.pushing.bodies import PlacedBody, between
from data_gen.pushing.settings import PushingSettings

_MAX_TRIALS = 1000
_LEAST_TIME = 0.05  # s, of a motion, however short


@dataclass(frozen=True)
class CommandedPath:
    """Straight motions from stop to stop; speed along each is a smooth bump whose mean is that of the motion."""

    places: NDArray[np.float64]  # (stop, 2) m
    times: NDArray[np.float64]  # (stop,) s, when each is reached

    def at(self, time: float) -> NDArray[np.float64]:
        """Return the commanded place (2,) at a time (s)."""
        index = int(np.clip(np.searchsorted(self.times, time, side="right") - 1, 0, len(self.times) - 2))
        share = np.clip((time - self.times[index]) / (self.times[index + 1] - self.times[index]), 0.0, 1.0)
        smooth = share * share * (3 - 2 * share)
        return self.places[index] + smooth * (self.places[index + 1] - self.places[index])


def draw_path(
    settings: PushingSettings, bodies: list[PlacedBody], duration: float, generator: np.random.Generator
) -> CommandedPath:
    """Draw motions for ``duration`` seconds; at first the pusher touches nothing."""
    is_task = generator.uniform() < settings.pusher.task_share
    stops = _push(settings, bodies, generator) if is_task else [_free_place(settings, bodies, generator)]
    times = [0.0]
    while True:
        for one, other in zip(stops[len(times) - 1 :], stops[len(times) :], strict=False):
            speed = between(settings.pusher.speed, generator)
            times.append(times[-1] + max(float(np.hypot(*(other - one))) / speed, _LEAST_TIME))
        if times[-1] >= duration:
            return CommandedPath(np.array(stops), np.array(times))
        limit = _limit(settings)
        stops += _push(settings, bodies, generator) if is_task else [generator.uniform(-limit, limit)]


def _limit(settings: PushingSettings) -> NDArray[np.float64]:
    return np.asarray(settings.table.half_size) + settings.pusher.overhang


def _push(
    settings: PushingSettings, bodies: list[PlacedBody], generator: np.random.Generator
) -> list[NDArray[np.float64]]:
    """Return where a push through a body's first place begins and where it ends."""
    pusher, limit = settings.pusher, _limit(settings)
    for _ in range(_MAX_TRIALS):
        body = bodies[int(generator.integers(len(bodies)))]
        angle = generator.uniform(0, 2 * np.pi)
        along = np.array([np.cos(angle), np.sin(angle)])
        gap = between(pusher.start_distance, generator)
        begin = body.place - along * (body.reach + pusher.radius + gap)
        end = body.place + along * (between(pusher.push_length, generator) - body.reach - pusher.radius)
        if (np.abs(begin) <= limit).all() and (np.abs(end) <= limit).all() and _is_free(begin, pusher.radius, bodies):
            return [begin, end]
    return [_free_place(settings, bodies, generator), bodies[0].place]


def _free_place(
    settings: PushingSettings, bodies: list[PlacedBody], generator: np.random.Generator
) -> NDArray[np.float64]:
    limit = _limit(settings)
    for _ in range(_MAX_TRIALS):
        place = generator.uniform(-limit, limit)
        if _is_free(place, settings.pusher.radius, bodies):
            return place
    return limit  # a corner: bodies keep a margin from the edge


def _is_free(place: NDArray[np.float64], radius: float, bodies: list[PlacedBody]) -> bool:
    return all(np.hypot(*(place - body.place)) > body.reach + radius for body in bodies)
