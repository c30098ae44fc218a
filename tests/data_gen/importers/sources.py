"""One small recording of every format that can be imported, for harm that no single format's test thinks of."""

import json
from pathlib import Path

from tests.data_gen.importers import test_kubric_folder as kubric
from tests.data_gen.importers import test_lerobot as lerobot
from tests.data_gen.importers import test_movi_records as movi
from tests.data_gen.importers import test_transforms_json as transforms
from tests.data_gen.importers import test_tum_rgbd as tum
from tests.data_gen.importers import tf_record_writer
from tests.data_gen.importers.known_scene import render
from tests.data_gen.importers.moving_camera import HEIGHT, INTRINSICS, WIDTH, pose
from tests.data_gen.importers.plain_recording import write_plain
from tests.data_gen.importers.ros_scene import film, make_bag


def write_all(folder: Path) -> list[str]:
    """Write each into a folder of its own below ``folder`` and return their names."""
    folder.mkdir(parents=True)
    write_plain(folder / "plain", num_frames=3, num_views=2)
    transforms.write_transforms(_new(folder / "transforms"), views=2)
    tum.write_sequence(folder / "tum", tum.TIMES[:4], _pictures(tum.TIMES[:4]))
    poses = [pose(time) for time in kubric.TIMES]
    kubric.write_scene(folder / "kubric", poses, _pictures(kubric.TIMES))
    poses = [pose(time) for time in movi.TIMES]
    record = tf_record_writer.example(movi.movi_features("00017", poses, _pictures(movi.TIMES)))
    movi.write_shard(_new(folder / "movi"), [record])
    (folder / "movi" / "features.json").write_text(json.dumps({}))
    lerobot.write_lerobot(folder / "lerobot", depth="png").rename(folder / "lerobot" / "mapping.yaml")
    for kind in ("ros1", "ros2", "mcap"):
        make_bag(_new(folder / kind), film(), kind)
    return sorted(path.name for path in folder.iterdir())


def _pictures(times: list[float]) -> list:
    return [render(INTRINSICS, pose(time), HEIGHT, WIDTH, time) for time in times]


def _new(folder: Path) -> Path:
    folder.mkdir(parents=True)
    return folder
