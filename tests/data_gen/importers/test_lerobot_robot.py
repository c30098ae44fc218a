"""Joint states of a LeRobot data set become points on the robot's links, by the model that the mapping names."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from data_gen.importers.robot_model import load_robot
from data_gen.importers.run import import_recordings
from tests.data_gen.importers.checks import attributes, files
from tests.data_gen.importers.test_lerobot import LENGTHS, write_lerobot
from tests.data_gen.importers.test_robot_model import ARM
from vpd_lightning.data.driven import read_driven
from vpd_lightning.errors import ConfigError, DataError

pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")

JOINTS = ["shoulder", "elbow", None]
BASE = [[0.0, -1.0, 0.0, 0.3], [1.0, 0.0, 0.0, 0.1], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]


@pytest.fixture
def source(tmp_path: Path) -> tuple[Path, Path, dict[str, np.ndarray]]:
    """A data set with joint states (degrees) and commands, its mapping, and the joint positions."""
    root = tmp_path / "robot"
    mapping = write_lerobot(root, depth="png")
    draw = np.random.default_rng(0)
    joints = {name: draw.uniform(-90, 90, (sum(LENGTHS), 3)) for name in ("observation.state", "action")}
    table = root / "data/chunk-000/file-000.parquet"
    columns = pq.read_table(table)
    for name, values in joints.items():
        columns = columns.append_column(name, pa.array(values.tolist()))
    pq.write_table(columns, table, row_group_size=5)
    info = json.loads((root / "meta/info.json").read_text())
    info["features"] |= {name: {"dtype": "float32", "shape": [3]} for name in joints}
    (root / "meta/info.json").write_text(json.dumps(info))
    (tmp_path / "arm.xml").write_text(ARM)
    return root, mapping, joints


def named(mapping: Path, **changes: Any) -> Path:
    entry = {"model": "arm.xml", "state": "observation.state", "command": "action", "joints": JOINTS, "unit": "deg"}
    entry |= {"base": BASE, "points": 40} | changes
    robot = {key: value for key, value in entry.items() if value is not ...}
    mapping.write_text(yaml.safe_dump({**yaml.safe_load(mapping.read_text()), "robot": robot}))
    return mapping


def test_links_follow_the_joints_of_each_episode(source: tuple[Path, Path, dict], tmp_path: Path) -> None:
    root, mapping, joints = source
    out = import_recordings(root, tmp_path / "out", {"mapping": str(named(mapping))})
    robot = load_robot(tmp_path / "arm.xml", 40)
    first = 0
    episodes = sorted(files(out), key=lambda path: str(attributes(path)["recording"]))
    for path, length in zip(episodes, LENGTHS, strict=True):
        found = read_driven(path)
        assert found is not None and found.poses is not None and found.commanded_poses is not None
        rows = slice(first, first + length)
        for poses, name in ((found.poses, "observation.state"), (found.commanded_poses, "action")):
            truth = robot.poses(["shoulder", "elbow"], np.radians(joints[name][rows, :2]), "rad", np.array(BASE))
            np.testing.assert_allclose(poses, truth, atol=1e-12)
        np.testing.assert_allclose(found.points, robot.motion(found.poses).points, atol=1e-6)
        first += length


def test_without_a_robot_nothing_is_given(source: tuple[Path, Path, dict], tmp_path: Path) -> None:
    root, mapping, _ = source
    out = import_recordings(root, tmp_path / "out", {"mapping": str(mapping)})
    assert all(read_driven(path) is None for path in files(out))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"model": "legs.xml"}, "there is no such file"),
        ({"joints": ["shoulder", "elbo", None]}, "no joint 'elbo'"),
        ({"joints": "shoulder"}, "list the model's joint of each number"),
        ({"unit": ...}, "unit"),
        ({"unit": "turns"}, "unit"),
        ({"state": "observation.joints"}, "observation.joints"),
        ({"state": ...}, "'state' is None; a name is needed"),
        ({"base": [[1.0]]}, "base"),
        ({"points": 0}, "allowed: 1 to 100,000"),
        ({"modell": "arm.xml"}, "did you mean 'model'"),
    ],
    ids=lambda value: "-".join(value) if isinstance(value, dict) else "",
)
def test_mistakes_in_the_mapping_are_named(
    source: tuple[Path, Path, dict], tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    root, mapping, _ = source
    with pytest.raises((ConfigError, DataError), match=message):
        import_recordings(root, tmp_path / "out", {"mapping": str(named(mapping, **changes))})


def test_another_number_of_joints_names_the_feature_and_the_episode(
    source: tuple[Path, Path, dict], tmp_path: Path
) -> None:
    root, mapping, _ = source
    with pytest.raises(DataError, match=r"observation.state of episode 0.*\(3, 3\); 2 joints are named"):
        import_recordings(root, tmp_path / "out", {"mapping": str(named(mapping, joints=["shoulder", "elbow"]))})
