"""What the viewer does, without a browser."""

import itertools
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch

pytest.importorskip("viser")

import trimesh

import vpd_lightning as vpd
from tests.editing.scenes import same
from tests.viewer.opened import open_tossed_box
from tests.waiting import HANG, wait_until
from vpd_lightning.editing.edit_files import load_edit, replay
from vpd_lightning.editing.operations import Delete, Duplicate, Move, SetVelocity
from vpd_lightning.editing.selectors import Box, Cluster, Everything
from vpd_lightning.errors import EditError
from vpd_lightning.media.camera_paths import read_camera_file
from vpd_lightning.renderer.base import AbstractRenderer
from vpd_lightning.viewer import progressive_view
from vpd_lightning.viewer.exports import ExportFolder
from vpd_lightning.viewer.frame_cache import FrameCache
from vpd_lightning.viewer.opened_scene import OpenedScene
from vpd_lightning.viewer.progressive_view import Pane, Pictures, ProgressiveView, Request
from vpd_lightning.viewer.session import Session
from vpd_lightning.viewer.viewpoints import FreeViewpoint, RecordedViewpoint

LEFT = Box([-9, -9, -9], [0, 9, 9])


@pytest.fixture(scope="module")
def opened(tmp_path_factory: pytest.TempPathFactory) -> OpenedScene:
    return open_tossed_box(tmp_path_factory.mktemp("session"))


def test_simulating_is_the_rollout_of_the_edited_scene(opened: OpenedScene) -> None:
    session, shown = Session(opened), []
    session.apply(Delete(LEFT))
    assert session.simulate(3, shown.append) and shown == [1, 2, 3]
    states = opened.simulator.rollout(vpd.SceneEditor(opened.scene).delete(LEFT).scene, 3)
    for one, other in zip(session.now.states[1:], states, strict=True):
        assert torch.equal(one.positions, other.positions) and torch.equal(one.mask, other.mask)
    session.apply(Move(Everything(), (0.0, 0.0, 0.1)))
    assert session.now.num_steps == 0  # what was simulated is of another scene


def test_an_edit_in_between_ends_a_simulation(opened: OpenedScene) -> None:
    session = Session(opened)

    def edit(step: int) -> None:
        if step == 2:
            session.apply(Delete(LEFT))

    assert not session.simulate(5, edit)
    assert session.now.num_steps == 0


def test_where_nobody_looks_any_more_nothing_is_simulated(opened: OpenedScene) -> None:
    session = Session(opened)
    session.apply(Delete(LEFT))
    assert session.simulate(1000, is_left=lambda: session.other.num_steps == 5)
    assert session.now.num_steps == 0 and session.other.num_steps == 5
    assert session.simulate(5, is_left=lambda: session.now.num_steps == 2)
    assert session.now.num_steps == 2


def test_what_was_simulated_is_not_simulated_again(opened: OpenedScene) -> None:
    one, other = Session(opened), Session(opened)
    one.simulate(3)
    states = list(one.now.states)
    other.simulate(2)
    assert all(a is b for a, b in zip(other.now.states, states, strict=False))  # the unedited scene is everybody's
    one.apply(Delete(LEFT), "without the left half")
    assert one.other is opened.rollout and one.label(one.now) == "without the left half"
    one.undo()
    assert one.now is opened.rollout and one.other is None and one.label(one.now) == "as recorded"
    one.redo()
    one.simulate(2)
    states = list(one.now.states)
    one.simulate(4)
    assert one.now.states[:3] == states and one.now.num_steps == 4
    assert one.label(one.now) == "without the left half"
    one.keep()
    one.apply(Move(Everything(), (0.0, 0.0, 0.1)))
    assert one.other is one.kept and one.label(one.now) == "without the left half, edited"
    one.start_over()
    assert one.now is opened.rollout and one.kept is None


def test_a_session_knows_how_fast_things_are(opened: OpenedScene) -> None:
    session = Session(opened)
    with pytest.raises(EditError):
        session.velocity(Cluster(len(session.cluster_sizes())))
    session.apply(SetVelocity(LEFT, (0.1, 0.0, 0.05)))
    assert np.allclose(session.velocity(LEFT), (0.1, 0.0, 0.05), atol=1e-5)


def test_bodies_and_surroundings_are_all_there_is(opened: OpenedScene) -> None:
    session = Session(opened)
    editor = session.now.editor
    there = editor.state.mask
    editor.state.clusters[:] = torch.where(there & (torch.arange(len(there)) % 3 == 0), 0, -1)
    try:
        assert session.body_names() == ["block"]
        bodies, surroundings = editor.select(session.bodies()), editor.select(session.surroundings())
        assert torch.equal(bodies, editor.state.clusters == 0) and torch.equal(surroundings, there & ~bodies)
    finally:
        editor.state.clusters[:] = -1
    assert session.bodies() is None and torch.equal(editor.select(session.surroundings()), there)


def test_where_nothing_moves_there_are_no_ways(opened: OpenedScene) -> None:
    session = Session(opened)
    session.simulate(2)
    assert session.motion(2, 50) is None  # the model learned nothing


def test_two_sessions_do_not_mix(opened: OpenedScene) -> None:
    one, other = Session(opened), Session(opened)
    one.apply(Delete(LEFT))
    other.apply(Duplicate(LEFT, (0.0, 1.0, 0.0)))
    assert [type(o).__name__ for o in one.operations()] == ["Delete"]
    assert [type(o).__name__ for o in other.operations()] == ["Duplicate"]
    other.undo()
    assert same(other.now.editor.scene, opened.scene) and not same(one.now.editor.scene, opened.scene)
    with pytest.raises(EditError, match="nothing to undo"):
        other.undo()


def test_selections_combine_as_sets(opened: OpenedScene) -> None:
    session = Session(opened)
    total, left = session.select(Everything()), session.select(LEFT)
    assert session.select(~LEFT, "add") == total
    assert session.select(LEFT, "subtract") == total - left
    assert session.select(LEFT, "intersect") == 0
    with pytest.raises(EditError, match="Nothing is selected"):
        session.need_selection()
    assert session.select(LEFT, "add") == left
    assert session.select(None) == 0


def test_a_kept_scene_stands_beside_and_is_swapped(opened: OpenedScene) -> None:
    session = Session(opened)
    with pytest.raises(EditError, match="Nothing is kept"):
        session.swap()
    session.keep()
    session.apply(Delete(LEFT))
    session.simulate(2)
    assert int(session.shown(2, of_kept=True)[0].mask.sum()) > int(session.shown(2)[0].mask.sum())
    session.swap()
    assert session.operations() == [] and session.kept.num_steps == 2


def test_figures_compare_with_the_recording_as_far_as_it_goes(opened: OpenedScene) -> None:
    session = Session(opened)
    last = opened.num_true_steps
    session.simulate(last + 1)
    image = session.render(0, opened.cameras[:1])[0]
    figures = session.measure(0, 0, image)
    assert 5 < figures["psnr"] < 60 and 0 < figures["chamfer"] < 0.5
    assert session.measure(0, 0, opened.truth[0, 0])["psnr"] == float("inf")
    assert set(session.measure(last + 1, 0, image)) == {"particles"} and not session.has_truth(last + 1)
    edited = Session(opened)
    edited.apply(Delete(LEFT))
    assert set(edited.measure(0, 0, image)) == {"particles"}  # what was recorded is not what was edited
    points, colors = opened.seen_points(0)
    assert len(points) == len(colors) > 100
    assert (points >= np.array(opened.workspace_min) - 1e-6).all() and (points <= np.array(opened.workspace_max)).all()


class Shown:
    def __init__(self) -> None:
        self.pictures: list[tuple[list[np.ndarray], bool]] = []
        self.event = threading.Event()
        self.changed = threading.Condition()

    def __call__(self, request: Request, pictures: Pictures, is_full: bool) -> None:
        assert len(pictures) == len(request.panes)
        with self.changed:
            self.pictures.append((list(pictures), is_full))
            self.changed.notify_all()
        if is_full:
            self.event.set()

    def wait_for(self, number: int) -> None:
        with self.changed:
            assert self.changed.wait_for(lambda: len(self.pictures) >= number, timeout=HANG)


def viewpoint(opened: OpenedScene, aspect: float = 1.0) -> FreeViewpoint:
    return FreeViewpoint(opened.cameras.cam_to_world[0].double().numpy(), 0.8, aspect)


def test_a_coarse_picture_comes_first_and_the_full_one_is_that_of_the_simulator(opened: OpenedScene) -> None:
    shown, state = Shown(), opened.scene.current
    view = ProgressiveView(opened.simulator.renderer, shown)
    view._pixels_per_second = 1.0  # a slow machine
    try:
        view.ask(Request([Pane(0, 0, state)], viewpoint(opened, 1.5), 40))
        assert shown.event.wait(HANG)
    finally:
        view.stop()
    ((coarse,), is_coarse_full), ((full,), is_full) = shown.pictures
    assert coarse.shape == (24, 36, 3) and not is_coarse_full
    assert full.shape == (40, 60, 3) and is_full
    whole = opened.simulator.render([state], viewpoint(opened, 1.5).cameras(40))[0, 0]
    assert np.abs(full.astype(int) - (whole * 255).round().numpy().astype(int)).max() <= 1  # bands: other sums


def test_a_film_is_drawn_ahead_and_loops_without_being_drawn_again(opened: OpenedScene) -> None:
    shown, frames, states = Shown(), FrameCache(), [opened.scene.current] * 4
    camera = RecordedViewpoint(opened.cameras[:1], 0)

    def request(step: int) -> Request:
        def pane(other: int) -> list[Pane]:
            return [Pane(7, other, states[other])]

        return Request(
            pane(step), camera, 24, lambda: [Request(pane(other), camera, 24) for other in range(len(states))]
        )

    counted = CountingRenderer(opened.simulator.renderer)
    view = ProgressiveView(counted, shown, frames)
    try:
        view.ask(request(0))
        counted.wait_for(4)
        wait_until(lambda: all(view.is_ready(request(step)) for step in range(4)))
        view.ask(request(2))  # what is kept is shown before this returns
        assert shown.pictures[-1][1] and np.array_equal(shown.pictures[-1][0][0], frames.get((7, 2, 0, 24)))
        states.append(opened.scene.current)  # one more step was simulated
        view.film_grew()
        counted.wait_for(5)
        view.ask(Request([Pane(7, 0, states[0])], RecordedViewpoint(opened.cameras[1:2], 1), 24))
        counted.wait_for(6)  # another camera sees something else
        assert counted.count == 6
        second = ProgressiveView(counted, shown, frames)  # another browser on the same scene
        assert second.is_ready(request(3)) and counted.count == 6
        second.stop()
    finally:
        view.stop()
    with pytest.raises(ValueError, match="read-only"):
        shown.pictures[-1][0][0][:] = 0


def test_what_was_drawn_for_an_older_request_is_shown_for_the_one_that_is_the_same(opened: OpenedScene) -> None:
    shown, camera = Shown(), RecordedViewpoint(opened.cameras[:1], 0)
    held = HeldRenderer(opened.simulator.renderer)
    view = ProgressiveView(held, shown)
    first, again = (Request([Pane(3, 0, opened.scene.current)], camera, 24) for _ in range(2))
    try:
        view.ask(first)
        held.wait()
        view.ask(again)  # while the first is drawn: the browser's camera said where it is
        held.draw()
        assert shown.event.wait(HANG)
        assert len(shown.pictures) == 1 and not held.begun.acquire(blocking=False)  # drawn once
    finally:
        held.let.release(100)
        view.stop()


class CountingRenderer:
    """A renderer that counts its drawings."""

    def __init__(self, renderer: AbstractRenderer) -> None:
        self.renderer, self.count = renderer, 0
        self.changed = threading.Condition()

    def __call__(self, *arguments: Any) -> Any:
        drawn = self.renderer(*arguments)
        with self.changed:
            self.count += 1
            self.changed.notify_all()
        return drawn

    def wait_for(self, count: int) -> None:
        with self.changed:
            assert self.changed.wait_for(lambda: self.count >= count, timeout=HANG)


class HeldRenderer:
    """A renderer that tells when a drawing begins, and draws when it is let."""

    def __init__(self, renderer: AbstractRenderer) -> None:
        self.renderer = renderer
        self.begun, self.let = threading.Semaphore(0), threading.Semaphore(0)

    def __call__(self, *arguments: Any) -> Any:
        self.begun.release()
        assert self.let.acquire(timeout=HANG)
        return self.renderer(*arguments)

    def wait(self) -> None:
        """Wait until it has begun to draw."""
        assert self.begun.acquire(timeout=HANG)

    def draw(self) -> None:
        """Let it draw once."""
        self.let.release()


def test_what_is_out_of_date_is_not_finished(opened: OpenedScene, monkeypatch: pytest.MonkeyPatch) -> None:
    ticks = itertools.count(
        step=100
    )  # each drawing takes 100 s by this clock: coarse pictures stay small, bands one row high
    monkeypatch.setattr(progressive_view, "time", SimpleNamespace(perf_counter=lambda: float(next(ticks))))
    monkeypatch.setattr(progressive_view, "STILL_SECONDS", 0.0)
    monkeypatch.setattr(progressive_view, "MIN_BAND", 16)  # one row of the pictures side by side
    shown, state = Shown(), opened.scene.current
    held = HeldRenderer(opened.simulator.renderer)
    view = ProgressiveView(opened.simulator.renderer, shown)
    view._renderer, view._pixels_per_second = held, 1.0
    old = Request([Pane(0, 0, state)], viewpoint(opened), 64)
    both = Request([Pane(1, 0, state), Pane(2, 0, state)], viewpoint(opened, 0.5), 32)
    try:
        view.ask(old)
        held.wait()
        view.ask(old)  # while the coarse picture of the first is drawn
        held.draw()
        held.wait()
        held.draw()  # the coarse picture of the second
        held.wait()
        held.draw()  # its first band
        held.wait()
        assert [image.shape for (image,), _ in shown.pictures] == [(24, 24, 3)] * 2
        monkeypatch.setattr(progressive_view, "STILL_SECONDS", 600.0)
        view.ask(old)  # while its second band is drawn
        held.draw()
        held.wait()
        held.draw()  # the coarse picture of the third, which then waits until the camera is still
        shown.wait_for(3)
        view.ask(both)  # two scenes side by side
        held.wait()
        monkeypatch.setattr(progressive_view, "STILL_SECONDS", 0.0)
        held.draw()
        for _ in range(1 + 2 * 32):
            held.wait()
            held.draw()
        assert shown.event.wait(HANG)
    finally:
        held.let.release(1000)
        view.stop()
    assert [images[0].shape[0] for images, is_full in shown.pictures if not is_full] == [24] * 4
    full = [images for images, is_full in shown.pictures if is_full]
    assert [image.shape for image in full[0]] == [(32, 16, 3)] * 2 and len(full) == 1
    assert np.array_equal(*full[0])
    assert not held.begun.acquire(blocking=False)  # no drawing but those counted


def test_exports_are_read_again_identically(opened: OpenedScene, tmp_path: Path) -> None:
    session, folder = Session(opened), ExportFolder(tmp_path / "view")
    session.apply(Delete(LEFT))
    session.simulate(3)
    state, colors = session.shown(2)
    there = state.mask[0].numpy()
    for suffix in ("ply", "glb"):
        path = folder.particles(state, colors, suffix)
        loaded = trimesh.load(path)
        cloud = next(iter(loaded.geometry.values())) if suffix == "glb" else loaded
        assert np.array_equal(np.asarray(cloud.vertices, np.float32), state.positions[0].numpy()[there])
        assert np.array_equal(np.asarray(cloud.colors)[:, :3], colors[there])
    with np.load(folder.particles(state, colors, "npz")) as arrays:
        assert np.array_equal(arrays["features"], state.features[0].numpy()[there])
    assert folder.particles(state, colors, "ply").name == "particles_002.ply"  # nothing is written over

    frames = np.stack([session.render(step, opened.cameras[:1])[0] for step in range(4)])
    film = cv2.VideoCapture(str(folder.film(frames, 10.0)))
    count = 0
    while film.read()[0]:
        count += 1
    assert count == 4

    assert same(replay(opened.scene, load_edit(folder.edit(session.operations()))).scene, session.now.editor.scene)
    with pytest.raises(EditError, match="Nothing was edited"):
        folder.edit([])
    cameras = viewpoint(opened, 1.5).cameras(48)
    read, moving = read_camera_file(folder.camera_path(cameras, 10.0))
    assert moving and (read.height, read.width) == (48, 72)
    assert torch.allclose(read.cam_to_world, cameras.cam_to_world, atol=1e-5)
    assert torch.allclose(read.intrinsics, cameras.intrinsics, atol=1e-3)
