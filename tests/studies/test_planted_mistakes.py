"""Mistakes that are planted into recordings, and what counts as named."""

import pytest

from data_gen.inspection.fault import Fault
from docs.results.studies.planted_mistakes import MISTAKES, judged, verdict
from tests.data.analytic_scene import known_trajectory


@pytest.mark.parametrize(
    ("mistake", "expected"), [("nothing", "nothing"), ("axes of OpenGL", "named"), ("a pose off along y", "named")]
)
def test_verdicts_on_an_exact_recording(mistake: str, expected: str) -> None:
    change, words = MISTAKES[mistake]
    assert judged([known_trajectory(0, height=96, width=128)], change, words)["verdict"] == expected


def test_an_error_that_says_something_else_does_not_count_as_named() -> None:
    _, words = MISTAKES["half a pixel"]
    blamed = [Fault("pose_off", "a.h5", "the pose of view 2 is off: ... Calibrate it again (pose, principal point)")]
    assert verdict(blamed, words) == "another fault"
    _, words = MISTAKES["a pose off along x"]
    assert (
        verdict([Fault("pose_off", "a.h5", "the pose of view 1 or view 2 is off: their colours")], words)
        == "one of two"
    )
    assert verdict([Fault("cannot_tell", "a.h5", "hides whether", is_error=False)], words) == "cannot tell"
