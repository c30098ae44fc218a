import json

import cv2
import h5py
import numpy as np
import pytest

from data_gen.importers.crc32c import crc32c, masked_crc32c
from data_gen.importers.movi_records import matches, recordings
from data_gen.importers.settings import ImportSettings
from data_gen.importers.tf_record import parse_example, read_record, record_spans
from tests.data_gen.importers import tf_record_writer as writer
from tests.data_gen.importers.known_scene import render
from tests.data_gen.importers.moving_camera import (
    FOCAL,
    HEIGHT,
    INTRINSICS,
    WIDTH,
    import_and_validate,
    largest_surface_distance,
    opengl,
    pose,
    quaternion_wxyz,
)
from vpd_lightning.errors import DataError

TIMES = [frame / 12 for frame in range(4)]


def png(image):
    done, data = cv2.imencode(".png", image)
    assert done
    return data.tobytes()


def movi_features(name, poses, pictures):
    """One video with the features and types of kubric/challenges/movi/movi_a.py, flattened as TFDS does."""
    distance = np.stack([picture.distance for picture in pictures]).astype(np.float32)
    low, high = float(distance.min()), float(distance.max())
    codes = np.round((distance - low) / (high - low) * 65535).astype(np.uint16)
    in_opengl = [opengl(matrix) for matrix in poses]
    return {
        "metadata/video_name": [name.encode()],
        "metadata/width": [WIDTH],
        "metadata/height": [HEIGHT],
        "metadata/num_frames": [len(poses)],
        "metadata/num_instances": [1],
        "metadata/depth_range": [low, high],
        "metadata/forward_flow_range": [-3.5, 4.0],
        "camera/focal_length": [35.0],
        "camera/sensor_width": [35.0 * WIDTH / FOCAL],
        "camera/field_of_view": [float(2 * np.arctan(WIDTH / 2 / FOCAL))],
        "camera/positions": [float(x) for matrix in in_opengl for x in matrix[:3, 3]],
        "camera/quaternions": [float(x) for matrix in in_opengl for x in quaternion_wxyz(matrix)],
        "video": [png(picture.rgb[..., ::-1]) for picture in pictures],
        "depth": [png(code) for code in codes],
        "segmentations": [png(np.zeros((HEIGHT, WIDTH), np.uint8)) for _ in pictures],
        "forward_flow": [1, 2, 300, 65535],
        "events/collisions/force": [0.5],
        "instances/category": [-1],
    }


def write_shard(folder, records, split="train", shard=0, shards=1, name="movi_a"):
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}-{split}.tfrecord-{shard:05d}-of-{shards:05d}"
    path.write_bytes(b"".join(writer.frame(record) for record in records))
    return path


@pytest.fixture(scope="module")
def known():
    poses = [pose(time) for time in TIMES]
    return poses, [render(INTRINSICS, c2w, HEIGHT, WIDTH, time) for c2w, time in zip(poses, TIMES, strict=True)]


@pytest.fixture(scope="module")
def record(known):
    return writer.example(movi_features("00017", *known))


@pytest.fixture
def dataset(tmp_path, record):
    folder = tmp_path / "movi_a" / "128x128" / "1.0.0"
    write_shard(folder, [record])
    splits = [
        {"name": "train", "shardLengths": ["1"], "filepathTemplate": "{DATASET}-{SPLIT}.{FILEFORMAT}-{SHARD_X_OF_Y}"}
    ]
    (folder / "dataset_info.json").write_text(
        json.dumps({"name": "movi_a", "fileFormat": "tfrecord", "splits": splits})
    )
    (folder / "features.json").write_text("{}")
    return folder


def test_crc32c_has_the_published_values():
    # Check value of the CRC catalogue, then the three vectors of RFC 3720, appendix B.4.
    assert crc32c(b"123456789") == 0xE3069283
    assert crc32c(bytes(32)) == 0x8A9136AA
    assert crc32c(b"\xff" * 32) == 0x62A8AB43
    assert crc32c(bytes(range(32))) == 0x46DD794E
    assert crc32c(b"") == 0
    assert writer.crc32c(b"123456789") == 0xE3069283


@pytest.mark.parametrize("size", [1, 1023, 1025, 4099, 65536, 100_003])
def test_crc32c_of_many_lanes_equals_byte_by_byte(size):
    data = np.random.default_rng(size).bytes(size)
    assert crc32c(data) == writer.crc32c(data)
    assert masked_crc32c(data) == writer.masked(writer.crc32c(data))


@pytest.mark.parametrize("is_packed", [True, False])
def test_features_are_read_packed_and_one_by_one(is_packed):
    features = {"a": [0.5, -2.0], "b": [-1, 0, 2**40], "c": [b"x", b""], "d": [7]}
    found = parse_example(writer.example(features, is_packed), {"a", "b", "c"}, "here")
    assert set(found) == {"a", "b", "c"}
    assert found["a"].tolist() == [0.5, -2.0]
    assert found["b"].tolist() == [-1, 0, 2**40]
    assert [bytes(value) for value in found["c"]] == [b"x", b""]


def test_recovers_cameras_colours_and_points(dataset, known):
    assert matches(dataset) and matches(dataset.parent.parent)
    (recording,) = recordings(dataset, ImportSettings())
    poses, pictures = known
    assert (recording.name, recording.split) == ("train/00017", "train")
    assert recording.frame_time == pytest.approx(1 / 12, abs=1e-12)
    np.testing.assert_allclose(recording.intrinsics, INTRINSICS[None], rtol=1e-7)  # float32 in the record
    np.testing.assert_allclose(recording.cam_to_world[:, 0], poses, atol=5e-7, rtol=0)  # float32 in the record
    distance = np.stack([picture.distance for picture in pictures])
    half_step = (distance.max() - distance.min()) / 65535 / 2
    for frame, picture in enumerate(pictures):
        np.testing.assert_array_equal(recording.read_rgb(frame, 0), picture.rgb)
        np.testing.assert_allclose(recording.read_depth(frame, 0), picture.depth, atol=half_step + 1e-6)
    assert half_step < 5e-5
    assert largest_surface_distance(recording, TIMES) < 1e-4
    assert recording.source["depth_type"] == "distance"
    assert recording.source["axes"] == "opengl"
    assert float(recording.source["depth_unit"]) == pytest.approx(2 * half_step, rel=1e-5)


def test_conventions_can_be_overruled(dataset, known):
    (recording,) = recordings(dataset, ImportSettings(axes="opencv", depth="z"))
    np.testing.assert_allclose(recording.cam_to_world[0, 0], opengl(known[0][0]), atol=5e-7)
    np.testing.assert_allclose(recording.read_depth(2, 0), known[1][2].distance, atol=1e-4)


def test_splits_come_from_the_file_names(tmp_path, known):
    for split, shards in (("train", 2), ("validation", 1), ("test", 1)):
        for shard in range(shards):
            features = movi_features(f"{split}{shard}", *known)
            write_shard(tmp_path, [writer.example(features, is_packed=False)], split, shard, shards, "movi_e")
    found = [(recording.name, recording.split) for recording in recordings(tmp_path, ImportSettings())]
    assert sorted(found) == [
        ("test/test0", "test"),
        ("train/train0", "train"),
        ("train/train1", "train"),
        ("validation/validation0", "validation"),
    ]


def test_one_shard_can_be_named(dataset):
    (shard,) = dataset.glob("*.tfrecord-*")
    assert matches(shard)
    assert len(list(recordings(shard, ImportSettings()))) == 1


def flip(path, position):
    data = bytearray(path.read_bytes())
    data[position] ^= 1
    path.write_bytes(bytes(data))


def test_a_flipped_bit_in_an_image_is_found_when_it_is_read(dataset, record):
    (shard,) = dataset.glob("*.tfrecord-*")
    flip(shard, 12 + record.index(b"IDAT") + 10)
    (recording,) = recordings(dataset, ImportSettings())
    with pytest.raises(DataError, match=r"record 0: the checksum of the data is wrong"):
        recording.read_rgb(0, 0)


@pytest.mark.parametrize(
    ("position", "message"), [(3, "a checksum is wrong; this is no TFRecord"), (12, "checksum of the data is wrong")]
)
def test_flipped_bits_in_length_and_message_are_found_at_once(dataset, position, message):
    (shard,) = dataset.glob("*.tfrecord-*")
    flip(shard, position)
    with pytest.raises(DataError, match=message):
        list(recordings(dataset, ImportSettings()))


@pytest.mark.parametrize("kept", [-1, -500, 20, 5])
def test_a_cut_off_record_is_named(dataset, kept):
    (shard,) = dataset.glob("*.tfrecord-*")
    shard.write_bytes(shard.read_bytes()[:kept])
    with pytest.raises(DataError, match=r"00000-of-00001, record 0: the file ends within the record"):
        list(recordings(dataset, ImportSettings()))


def test_a_shard_that_lost_whole_records_is_named(dataset):
    (shard,) = dataset.glob("*.tfrecord-*")
    shard.write_bytes(b"")
    with pytest.raises(DataError, match=r"has 0 records, dataset_info.json says 1"):
        list(recordings(dataset, ImportSettings()))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"depth": None}, "has no depth"),
        ({"camera/quaternions": None}, "has no quaternions"),
        ({"camera/positions": [0.0, 1.0, 2.0, 3.0]}, "rows of 3 numbers"),
        ({"camera/quaternions": [2.0, 0.0, 0.0, 0.0] * 4}, "quaternion has length 2"),
        ({"metadata/depth_range": [1.0, 1e10]}, "empty background"),
        ({"metadata/depth_range": [5.0, 1.0]}, "smallest first"),
        ({"video": [b"x"]}, "1 colour and 4 depth images"),
    ],
)
def test_names_what_is_missing_or_wrong(tmp_path, known, change, message):
    features = {key: value for key, value in {**movi_features("a", *known), **change}.items() if value is not None}
    write_shard(tmp_path, [writer.example(features)])
    with pytest.raises(DataError, match=message):
        list(recordings(tmp_path, ImportSettings()))


def test_refuses_several_builds_other_files_and_compressed_ones(tmp_path, record):
    write_shard(tmp_path / "128x128" / "1.0.0", [record])
    write_shard(tmp_path / "256x256" / "1.0.0", [record])
    with pytest.raises(DataError, match="holds 2 builds"):
        list(recordings(tmp_path, ImportSettings()))
    other = write_shard(tmp_path / "other", [b"no example"])
    with pytest.raises(DataError, match="not a tf.train.Example"):
        list(recordings(other, ImportSettings()))
    other.write_bytes(b"\x1f\x8b\x08" + bytes(30))
    with pytest.raises(DataError, match="gunzip"):
        list(recordings(other, ImportSettings()))


def test_spans_are_found_without_reading_the_data(tmp_path):
    path = tmp_path / "x-train.tfrecord-00000-of-00001"
    path.write_bytes(writer.frame(b"abc") + writer.frame(b"") + writer.frame(b"d" * 5000))
    spans = list(record_spans(path))
    assert [span.length for span in spans] == [3, 0, 5000]
    assert read_record(spans[2]) == b"d" * 5000


def test_imports_into_a_valid_data_set(dataset, tmp_path, known):
    report = import_and_validate(dataset, tmp_path / "out")
    assert report.faults == []
    with h5py.File(tmp_path / "out" / "train" / "000000.h5") as file:
        assert file.attrs["source_format"] == "movi"
        assert file.attrs["source_axes"] == "opengl"
        assert file.attrs["source_depth_type"] == "distance"
        np.testing.assert_allclose(file["cam_to_world"][:, 0], known[0], atol=5e-7)


@pytest.mark.parametrize(
    ("mistake", "suggestion"),
    [({"axes": "opencv"}, "axes are OpenGL's"), ({"depth": "z"}, "depth is the distance to the camera centre")],
)
def test_validate_names_a_mistaken_convention(dataset, tmp_path, mistake, suggestion):
    report = import_and_validate(dataset, tmp_path / "out", **mistake)
    assert not report.is_valid
    assert suggestion in str(report.faults[0])
