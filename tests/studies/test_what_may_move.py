"""Joining what was measured of what may move."""

import json
from pathlib import Path

from docs.results.studies.what_may_move import joined


def test_the_worst_scene_stands_for_each_size_sensor_and_noise(tmp_path: Path) -> None:
    first = {"a/64/active_stereo/0.5": {"precision": 0.9, "recall": 0.8}}
    second = {
        "b/64/active_stereo/0.5": {"precision": 0.7, "recall": 0.95},
        "b/128/active_stereo/0.5": {"precision": 0.99, "recall": 0.98},
    }
    for name, cells in (("one", first), ("two", second)):
        (tmp_path / name).write_text(json.dumps({"times": [0], "split": "test", "cells": cells}))

    found = joined([f"after={tmp_path / 'one'},{tmp_path / 'two'}", f"before={tmp_path / 'one'}"])

    assert found["after"] == first | second and found["before"] == first
    assert found["worst"]["after"] == {
        "64/active_stereo/0.5": {"precision": 0.7, "recall": 0.8, "scenes": 2},
        "128/active_stereo/0.5": {"precision": 0.99, "recall": 0.98, "scenes": 1},
    }
