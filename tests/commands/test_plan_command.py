"""``vpd-plan`` from its words to its film, with a model that takes actions, trained for one update."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from data_gen.generate import generate
from data_gen.gl_backend import working_backend
from tests.evaluation.tossed_box import write_tossed_boxes
from tests.evaluation.untrained_model import write_untrained
from vpd_lightning.commands import eval, plan, render, train

BACKEND = working_backend()
TRAINING = (
    "experiment=pushing model=inertial encoder=unet_moving budget=tiny trainer.max_steps=1 data.num_validation_clips=0 "
    "trainer.val_check_interval=null data.batch_size=1 data.num_steps=2 data.num_steps_schedule=null evaluate=false "
    "data.rays_per_step=16 encoder.num_particles=200 logger=csv callbacks.draw_rollouts=null light_fit.num_pairs=1 "
    "light_fit.num_updates=1 scene.input_views=[0,1] force=true"
)
SHORT = "num_decisions=2 num_knots=2 num_executed=1 hold=2 solver.num_samples=3 solver.num_elites=2 preset=tiny"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if BACKEND is None:
        pytest.skip("no GL on this machine: the pushing scene has no other renderer")
    folder = tmp_path_factory.mktemp("plan")
    sizes = {"splits.train": 1, "splits.validation": 1, "splits.test": 1, "num_frames": 12}
    generate("pushing", "tiny", out=folder / "data", seed=0, renderer=BACKEND, workers=1, overrides=sizes)
    words = [f"data.folder={folder / 'data'}", f"run.folder={folder / 'run'}"]
    assert train.main([*TRAINING.split(), *words]) == 0
    return folder / "run"


def test_it_plans_acts_and_films(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "plan"
    # A process of its own: MuJoCo takes its GL backend when it is imported, and other tests may have done that.
    command = [sys.executable, "-m", "vpd_lightning.commands.plan", f"ckpt={run}", f"out={out}", "task=make_room"]
    done = subprocess.run([*command, *SHORT.split()], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "make_room, world 1000, by model: not solved" in done.stdout
    assert "decision 2/2: cost of the plan" in done.stderr
    assert sorted(path.name for path in out.iterdir()) == ["plan.json", "plan.webm"]
    found = json.loads((out / "plan.json").read_text())
    assert len(found["seconds_per_decision"]) == len(found["costs"]) == 2 and len(found["places"]) == 3
    assert found["contact"] == {"num_probes": 64, "num_contact_substeps": 2}
    assert found["task"] == "make_room" and found["seed"] == 1000 and not found["solved"]


@pytest.mark.parametrize("words", ["system=nothing", "system=truth task=off_table"])
def test_the_references_need_no_pictures(run: Path, tmp_path: Path, words: str) -> None:
    out = tmp_path / "plan"
    assert plan.main([f"ckpt={run}", f"out={out}", *words.split(), *SHORT.split()]) == 0
    assert [path.name for path in out.iterdir()] == ["plan.json"]


def test_the_recorded_action_is_given_to_evaluations_and_films(run: Path, tmp_path: Path) -> None:
    words = "protocol.num_trajectories=1 protocol.num_steps=3 protocol.num_long_steps=20 num_videos=0 force=true"
    assert eval.main([f"ckpt={run}", f"out={tmp_path / 'evaluation'}", *words.split()]) == 0
    film = "num_steps=20 height=16 width=16 save_particles=[]"
    assert render.main([f"ckpt={run}", f"out={tmp_path / 'film'}", *film.split()]) == 0


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("task=juggle", "Allowed: place, off_table, make_room."),
        ("data.folder=somewhere", "data.folder has no effect here"),
        ("system=luck", "Allowed: model, truth, nothing."),
        ("solver.name=prayer", "Allowed: cem, mppi, random."),
        ("solver.num_elites=0", "num_elites from 1 to num_samples"),
        ("solver.num_samples=0", "solver.num_samples and num_iterations are"),
        ("num_executed=9", "num_executed=9 actions cannot be taken of a plan of 6"),
        ("num_decisions=0", "num_decisions=0 is out of range"),
        ("contact.num_probes=0", "contact.num_probes=0 is out of range"),
        ("max_speed=0", "must be above 0"),
        ("preset=huge", "huge"),
        ("backend=pencil", "Allowed: auto, egl, osmesa."),
    ],
)
def test_what_makes_no_sense_is_refused(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: str, message: str
) -> None:
    assert plan.main([f"ckpt={run}", f"out={tmp_path / 'plan'}", words]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "plan").exists()


def test_a_model_without_actions_cannot_plan(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    checkpoint = write_untrained(tmp_path / "run", write_tossed_boxes(tmp_path / "data", num_train=1, num_test=1))
    assert plan.main([f"ckpt={checkpoint}", f"out={tmp_path / 'plan'}"]) == 2
    assert "was trained without actions" in capsys.readouterr().err
