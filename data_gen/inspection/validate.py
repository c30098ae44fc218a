"""Checking a data set: every file on its own, and whether depths and poses of different views agree.

What cannot be right is a fault; what a person should know, such as that the views cannot tell two conventions apart, is
a remark. See ``view_agreement`` and ``free_space`` for what is compared between views.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from data_gen.inspection.camera_conventions import STORED, CameraConvention, single_mistakes
from data_gen.inspection.fault import Fault
from data_gen.inspection.free_space import MAX_SHARE, FreeSpace, free_space_violations
from data_gen.inspection.pose_agreement import MAX_MISPLACED, Misplacement, explanation, misplacements, outlier_views
from data_gen.inspection.posed_depth import PosedDepth
from data_gen.inspection.trigger_delay import MAX_DELAY, TriggerDelay, trigger_delays
from data_gen.inspection.view_agreement import MAX_PAIRS, Agreement, compare_views
from vpd_lightning.data import schema
from vpd_lightning.data.driven import read_driven
from vpd_lightning.data.ground_truth import has_state, read_state
from vpd_lightning.data.hdf5.broken_file import BrokenFileError
from vpd_lightning.data.hdf5.checks import open_file
from vpd_lightning.data.manifest import FILE_NAME, file_sha256, load_manifest
from vpd_lightning.data.reader import TrajectoryReader
from vpd_lightning.errors import DataError

MAX_RELATIVE_DISTANCE = 0.02  # of the depth: between correct sensors, after leaving out occlusions
_MAX_FILES_COMPARED = 4
_MIN_PAIRS = 4  # of images, per file
_MANY = 4  # times as many pairs are compared where the first ones leave open which view is off
_NOISY = 1e-3  # of the depth: beyond this it is noise, not the views, that hides small differences
_PER_FRAME_STATE = (
    schema.STATE_POSITIONS,
    schema.STATE_QUATERNIONS,
    schema.STATE_LINEAR_VELOCITIES,
    schema.STATE_ANGULAR_VELOCITIES,
    schema.STATE_SEGMENTATION,
    "vertices",
)


@dataclass(frozen=True)
class Report:
    """All faults and remarks, and one line about what was compared."""

    faults: list[Fault]
    summary: str

    @property
    def is_valid(self) -> bool:
        """Whether there are at most remarks."""
        return not any(fault.is_error for fault in self.faults)


@dataclass(frozen=True)
class _Views:
    """What comparing the views of one file gave; None where nothing could be compared."""

    faults: list[Fault]
    agreement: Agreement | None
    free_space: FreeSpace


def validate_dataset(path: str | Path) -> list[Fault]:
    """Check a data set folder or one ``.h5`` file and return all faults and remarks; an empty list means none."""
    return check_dataset(path).faults


def check_dataset(path: str | Path) -> Report:
    """Check a data set folder or one ``.h5`` file: everything ``vpd-data validate`` says."""
    path = Path(path)
    if path.is_file():
        faults = validate_trajectory(path)
        compared = [_check_views(path)] if _is_comparable(faults) else []
        faults += [fault for item in compared for fault in item.faults]
        delays = _delays([path] if compared else [], faults)
        return Report(faults + _judge_delays(path, path, delays), _summary(path, compared, delays))
    faults = []
    try:
        manifest = load_manifest(path)
        files = [file for members in manifest.splits.values() for file in members]
    except DataError as error:
        faults.append(Fault("manifest", FILE_NAME, _one_line(error)))
        manifest, files = None, sorted(path.glob("*/*.h5")) + sorted(path.glob("*.h5"))
        if not files:
            return Report(faults, _summary(path, []))
    shapes: dict[tuple[int, ...], Path] = {}
    comparable = []
    for file in files:
        found = validate_trajectory(file)
        if manifest is not None and file_sha256(file) != manifest.sha256[manifest.relative(file)]:
            found.append(Fault("checksum", str(file), f"its SHA-256 differs from {FILE_NAME}"))
        faults += found
        if _is_comparable(found):
            comparable.append(file)
            with TrajectoryReader(file) as reader:
                shapes.setdefault((reader.num_views, reader.height, reader.width), file)
    if not files:
        faults.append(Fault("empty", str(path), "it holds no trajectories"))
    if len(shapes) > 1:
        listed = "; ".join(f"{shape} in {file.name}" for shape, file in shapes.items())
        faults.append(Fault("mixed_shapes", str(path), f"(views, height, width) differ between files: {listed}"))
    stride = max(1, len(comparable) // _MAX_FILES_COMPARED)
    chosen = comparable[::stride][:_MAX_FILES_COMPARED]
    compared = [_check_views(file, max(_MIN_PAIRS, MAX_PAIRS // max(len(chosen), 1))) for file in chosen]
    for item in compared:
        said = {(fault.name, fault.message) for fault in faults if not fault.is_error}
        faults += [fault for fault in item.faults if fault.is_error or (fault.name, fault.message) not in said]
    delays = _delays(chosen, faults)
    if delays:
        faults += _judge_delays(path, chosen[0], delays)
    return Report(faults, _summary(path, compared, delays))


def validate_trajectory(path: Path) -> list[Fault]:
    """Check one file: structure, cameras, that all bytes can be read, and plausible values."""
    try:
        with TrajectoryReader(path) as reader:
            faults = []
            is_measured, is_inside = False, False
            for time in range(reader.num_frames):
                reader.rgb([time])
                depth = reader.depth([time])
                is_measured = is_measured or bool((depth > 0).any())
                is_inside = is_inside or _inside_share(_posed_depth(reader, time, depth), STORED, reader) > 0
            if is_measured and not is_inside:
                faults.append(Fault("empty_workspace", str(path), _empty_workspace(reader)))
            faults += _check_state(path, reader)
            read_driven(path)
    except DataError as error:
        kind = error.kind if isinstance(error, BrokenFileError) else "unreadable"
        return [Fault(kind, str(path), _one_line(error, str(path)))]
    if not is_measured:
        faults.append(Fault("no_depth", str(path), "not one pixel has a depth"))
    return faults


def convention_errors(path: Path) -> dict[str, float]:
    """Return, per camera convention, the median distance between views relative to depth.

    ``as stored`` is the convention the format prescribes. Empty where there is no second look at anything.
    """
    with TrajectoryReader(path) as reader:
        agreement = compare_views(reader)
    return agreement.errors if agreement is not None else {}


def _is_comparable(faults: list[Fault]) -> bool:
    """Whether a file can be read and has depth, so that its views can be compared."""
    return all(fault.name in ("empty_workspace", "state_length") for fault in faults)


def _check_views(path: Path, max_pairs: int = MAX_PAIRS) -> _Views:
    with TrajectoryReader(path) as reader:
        agreement = compare_views(reader, max_pairs)
        poses = misplacements(reader, max_pairs)
        worst = outlier_views(poses)
        if worst is not None and len(worst[0]) > 1:  # other views may tell which of the two it is
            more = misplacements(reader, _MANY * max_pairs)
            poses = more if outlier_views(more) is not None else poses
        undecidable = agreement.undecidable if agreement is not None else ()
        convention = explanation(reader, max_pairs, undecidable, poses)
    free_space = free_space_violations(path)
    faults = [Fault("cannot_tell", str(path), _STATIC_VIEW, is_error=False)]
    if agreement is not None:
        faults = _judge(path, agreement)
    if not any(fault.is_error for fault in faults) or (agreement is not None and agreement.explanation is None):
        faults += _judge_poses(path, poses, convention)
    if not any(fault.is_error for fault in faults) and free_space.share > MAX_SHARE:
        faults.append(_judge_free_space(path, free_space))
    return _Views(faults, agreement, free_space)


_EXACT = 3e-4  # of the depth: rendered data, or a sensor's millimetres; above it half a pixel looks like bad poses
_NUMBERS_OF_STATE = (
    schema.STATE_POSITIONS,
    schema.STATE_QUATERNIONS,
    schema.STATE_LINEAR_VELOCITIES,
    schema.STATE_ANGULAR_VELOCITIES,
)
_UNIT = 1e-3
_STATIC_VIEW = (
    "one camera that stands still sees every point once: nothing here can tell whether depth and poses follow the "
    "conventions (a second view or a moving camera can)"
)


def _judge(path: Path, agreement: Agreement) -> list[Fault]:
    """What the comparison of views means."""
    apart = f"points seen twice are {_percent(agreement.distance)} of their depth apart (median"
    if agreement.explanation is not None:
        better = f"it would be {_percent(agreement.explained_distance)} if {agreement.explanation}"
        shared = f"{apart})" if np.isfinite(agreement.distance) else "the images share no points as they are stored"
        if replace(agreement.explanation, pixel_shift=0.0) == STORED and agreement.explained_distance > _EXACT:
            # Poses that are a little off are often compensated by half a pixel.
            better += ", but calibration errors of this size look alike"
            return [Fault("views_disagree", str(path), f"{shared}; {better}", is_error=False)]
        return [Fault("views_disagree", str(path), f"{shared}; {better}")]
    if not np.isfinite(agreement.distance):
        message = "no two images share enough measured points: nothing tells whether depth and poses agree"
        return [Fault("cannot_tell", str(path), message, is_error=False)]
    if agreement.distance > MAX_RELATIVE_DISTANCE:
        apart += f"; allowed {MAX_RELATIVE_DISTANCE:.0%}), and no other convention explains it"
        if agreement.is_over_time:  # then the scene itself may have moved
            message = f"{apart}; compared was each camera with itself at other times: does the whole scene move?"
            return [Fault("views_disagree", str(path), message, is_error=False)]
        return [Fault("views_disagree", str(path), f"{apart}: are the cameras calibrated, and do their times agree?")]
    if agreement.undecidable:
        listed = " | ".join(str(convention).split(":")[0] for convention in agreement.undecidable)
        is_noise = agreement.distance > _NOISY
        reason = "the depth's noise hides" if is_noise else "views too alike, or surfaces too flat, to tell"
        message = f"{reason} whether: {listed}"
        return [Fault("cannot_tell", str(path), message, is_error=False)]
    return []


def _judge_poses(path: Path, found: Sequence[Misplacement], convention: CameraConvention | None) -> list[Fault]:
    worst = outlier_views(found)
    if convention is not None:
        apart = float(np.median([item.distance / item.depth for item in found]))
        message = (
            f"views lie {_percent(apart)} of their depth apart (median over pairs, all their points together); they "
            f"would agree if {convention}"
        )
        if replace(convention, pixel_shift=0.0) == STORED:
            message += ", but calibration errors of this size look alike"
        is_error = worst is not None or replace(convention, pixel_shift=0.0) != STORED
        return [Fault("views_disagree", str(path), message, is_error=is_error)]
    if worst is None:
        return []
    suspects, pair = worst
    with TrajectoryReader(path) as reader:
        named = [reader.view_label(view) for view in suspects]
        others = [reader.view_label(view) for view in pair.views if view not in suspects]
    length = f"{100 * pair.distance:.2g} cm (standard error {100 * pair.error:.1g} cm)"
    if others:
        where = f"view {named[0]} is off: its {pair.evidence} lie {length} from those of view {others[0]}"
    else:
        where = f"view {named[0]} or view {named[1]} is off: their {pair.evidence} lie {length} from each other"
    remedy = "Calibrate it again (pose, principal point), or trigger the cameras together"
    share = f"{_percent(pair.distance / pair.depth)} of their depth; allowed {_percent(MAX_MISPLACED)}"
    message = f"the pose of {where}, {share}. {remedy}"
    return [Fault("pose_off", str(path), message)]


def _delays(paths: list[Path], faults: list[Fault]) -> list[TriggerDelay]:
    """How late each view is; not asked where something else is wrong, which could look like it."""
    return [] if any(fault.is_error for fault in faults) else trigger_delays(paths)


def _judge_delays(path: Path, file: Path, delays: list[TriggerDelay]) -> list[Fault]:
    certain = [item for item in delays if item.is_certain]
    if not certain:
        return []
    worst = max(certain, key=lambda item: abs(item.delay))
    with TrajectoryReader(file) as reader:
        name, *others = (reader.view_label(view) for view in (worst.view, *worst.others))
    message = (
        f"view {name} is taken {1e3 * abs(worst.delay):.3g} ms (standard error {1e3 * worst.error:.1g} ms) "
        f"{'later' if worst.delay > 0 else 'earlier'} than view{'s' if len(others) > 1 else ''} {', '.join(others)}, "
        f"as what moves tells; allowed is {MAX_DELAY:.0%} of the {1e3 * worst.frame_time:.3g} ms between frames. "
        "Trigger the cameras together, or pair its frames with those of the others by their time stamps"
    )
    return [Fault("trigger_delay", str(path), message)]


def _judge_free_space(path: Path, free_space: FreeSpace) -> Fault:
    message = (
        f"{free_space.share:.1%} of {free_space.num_points} points lie in front of what another view sees there "
        f"(allowed {MAX_SHARE:.0%})"
    )
    if free_space.share_beyond_noise <= MAX_SHARE:
        noise = f"; the depth's noise of {_percent(free_space.noise)} explains it"
        return Fault("free_space", str(path), message + noise, is_error=False)
    first, second = max(free_space.pairs, key=free_space.pairs.__getitem__)
    with TrajectoryReader(path) as reader:
        names = [reader.view_label(view) for view in (first, second)]
    worst = f"; most are points of view {names[0]} seen from view {names[1]} ({free_space.pairs[first, second]:.1%})"
    return Fault("free_space", str(path), message + worst)


def _summary(path: Path, compared: list[_Views], delays: Sequence[TriggerDelay] = ()) -> str:
    agreements = [item.agreement for item in compared if item.agreement is not None]
    distances = [agreement.distance for agreement in agreements if np.isfinite(agreement.distance)]
    parts = ["no views compared"]
    if distances:
        num_pairs = sum(agreement.num_pairs for agreement in agreements)
        parts = [f"median cross-view distance {_percent(float(np.median(distances)))} of the depth ({num_pairs} pairs)"]
    num_points = sum(item.free_space.num_points for item in compared)
    if num_points:
        share = sum(item.free_space.share * item.free_space.num_points for item in compared) / num_points
        parts.append(f"free-space violations {_percent(share)} of {num_points} points")
    if delays and all(item.is_known for item in delays):
        worst = max(delays, key=lambda item: abs(item.delay))
        parts.append(f"views taken within {1e3 * abs(worst.delay):.1f} +- {1e3 * worst.error:.1f} ms of each other")
    return f"{path}: {len(compared)} {'file' if len(compared) == 1 else 'files'} compared, " + ", ".join(parts)


def _posed_depth(reader: TrajectoryReader, time: int, depth: NDArray[np.float32]) -> list[PosedDepth]:
    intrinsics, cam_to_world = (array[0] for array in reader.cameras([time]))
    return [PosedDepth(*parts) for parts in zip(depth[0], intrinsics, cam_to_world, strict=True)]


def _inside_share(images: list[PosedDepth], convention: CameraConvention, reader: TrajectoryReader) -> float:
    """Share of the measured points that lie in the workspace; 0 where they all lie in one tiny part of it."""
    points = np.concatenate([(image if convention == STORED else convention.read(image)).points() for image in images])
    low, high = np.array(reader.workspace_min), np.array(reader.workspace_max)
    is_inside = ((points >= low) & (points <= high)).all(axis=-1)
    if not is_inside.any() or (
        convention != STORED and np.ptp(points[is_inside], axis=0).max() < 0.1 * (high - low).max()
    ):
        return 0.0
    return float(is_inside.mean())


def _empty_workspace(reader: TrajectoryReader) -> str:
    """Say that no point is inside, and which convention of poses and depth would bring some there."""
    images = _posed_depth(reader, 0, reader.depth([0]))
    conventions = [
        convention for convention in single_mistakes() if not convention.pixel_shift and not convention.ray_power
    ]
    conventions += [CameraConvention(depth_scale=1e-3, translation_scale=1e-3)]
    conventions += [replace(convention, axes="opengl") for convention in conventions if convention.axes == "opencv"]
    shares = {convention: round(_inside_share(images, convention, reader), 1) for convention in conventions}
    best = max(conventions, key=shares.__getitem__)  # the first, simplest one of equals
    message = "not one measured pixel lies in the workspace "
    if shares[best]:
        return f"{message}({shares[best]:.0%} would if {best})"
    return f"{message}(are depth in metres, cam_to_world and workspace_min/max in one frame?)"


def _check_state(path: Path, reader: TrajectoryReader) -> list[Fault]:
    """Ground truth, where there is any, must have one entry per frame, and hold numbers and rotations."""
    with open_file(path) as file:
        group = file.get(schema.STATE)
        if not isinstance(group, h5py.Group):
            return []
        wrong = [
            name
            for name in _PER_FRAME_STATE
            if name in group
            and not (isinstance(group[name], h5py.Dataset) and group[name].shape[:1] == (reader.num_frames,))
        ]
    faults = [Fault("state_length", str(path), f"state/{name} has not one entry per frame") for name in wrong]
    if faults or not has_state(path):
        return faults
    state = read_state(path)
    for name in (*_NUMBERS_OF_STATE, schema.STATE_HALF_SIZES):
        if not np.isfinite(getattr(state, name)).all():
            faults.append(Fault("state_not_finite", str(path), f"state/{name} is not finite everywhere"))
    if np.abs(np.linalg.norm(state.quaternions, axis=-1) - 1).max() > _UNIT:
        faults.append(Fault("state_quaternions", str(path), "state/quaternions are not of unit length"))
    return faults


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %"


def _one_line(error: BaseException, prefix: str = "") -> str:
    return " ".join(str(error).removeprefix(prefix + ": ").split())
