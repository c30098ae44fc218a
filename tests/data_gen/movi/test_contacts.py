import mujoco
import numpy as np
import pytest

from data_gen.movi.contact_calibration import bounce, measure_restitution, slide
from data_gen.movi.contacts import (
    CALIBRATED_TIMESTEP,
    RESTITUTION_TABLE,
    Surface,
    option_xml,
    pair_xml,
    solver_reference,
)
from data_gen.movi.settings import MoviSettings
from data_gen.settings import load_settings

GRAVITY = 10.0


def materials(scene: str) -> tuple[list[Surface], Surface]:
    settings = load_settings(MoviSettings, scene, "paper", {})
    thrown = [Surface(material.friction, material.restitution) for material in settings.objects.materials]
    return thrown, Surface(settings.floor.friction, settings.floor.restitution)


def contacts_that_occur() -> list[Surface]:
    """Floor with object and object with object, of MOVi-A and MOVi-C, each once."""
    found = set()
    for scene in ("movi_a", "movi_c"):
        thrown, floor = materials(scene)
        found |= {(one.against(other).friction, one.against(other).restitution) for one in thrown for other in thrown}
        found |= {(floor.against(one).friction, floor.against(one).restitution) for one in thrown}
    return [Surface(*values) for values in sorted(found)]


def test_contacts_have_the_products_of_kubrics_materials():
    """Bullet multiplies; metal (.4, .3), rubber (.8, .7), scans (.5, .5), floor (.3, .5)."""
    expected = [
        (0.12, 0.15), (0.24, 0.35), (0.16, 0.09), (0.32, 0.21), (0.64, 0.49),
        (0.15, 0.25), (0.25, 0.25),
    ]  # fmt: skip
    found = [(contact.friction, contact.restitution) for contact in contacts_that_occur()]
    np.testing.assert_allclose(found, sorted(expected), atol=1e-12)


@pytest.mark.parametrize("contact", contacts_that_occur(), ids=lambda contact: f"{contact.restitution:.2f}")
@pytest.mark.parametrize("speed", [3.0, 6.0, 9.0])
def test_spheres_bounce_with_the_wanted_restitution(contact: Surface, speed: float):
    """At speeds between those of the calibration; single impacts scatter, depending on when in a step they begin."""
    pair = pair_xml("floor", "ball", contact)
    measured = [bounce(pair, speed, phase) for phase in (0.1, 0.3, 0.5, 0.7, 0.9)]
    assert np.mean(measured) == pytest.approx(contact.restitution, abs=0.05)
    np.testing.assert_allclose(measured, contact.restitution, atol=0.08)


@pytest.mark.parametrize("contact", contacts_that_occur(), ids=lambda contact: f"{contact.friction:.2f}")
def test_boxes_slide_with_coulombs_deceleration(contact: Surface):
    deceleration = slide(pair_xml("floor", "ball", contact), speed=8.0, duration=1.0)
    assert deceleration == pytest.approx(contact.friction * GRAVITY, rel=0.05)


@pytest.mark.parametrize("restitution", [0.09, 0.21, 0.25, 0.49])
@pytest.mark.parametrize("mass_ratio", [1.0, 15.0])
def test_spheres_in_mid_air_bounce_off_each_other(restitution: float, mass_ratio: float):
    """Restitution by its definition: ratio of the relative speeds; momentum is kept."""
    model = mujoco.MjModel.from_xml_string(f"""
<mujoco>
  {option_xml(CALIBRATED_TIMESTEP)}
  <worldbody>
    <body pos="-0.6 0 0"><freejoint/><geom name="a" type="sphere" size="0.5" mass="1"/></body>
    <body pos="0.6 0 0"><freejoint/><geom name="b" type="sphere" size="0.5" mass="{mass_ratio}"/></body>
  </worldbody>
  <contact>{pair_xml("a", "b", Surface(0.3, restitution))}</contact>
</mujoco>""")
    data = mujoco.MjData(model)
    model.opt.gravity[:] = 0
    measured = []
    for phase in (0.0, 0.25, 0.5, 0.75):
        mujoco.mj_resetData(model, data)
        data.qpos[7] += phase * 5.0 * CALIBRATED_TIMESTEP
        data.qvel[0] = 5.0
        mujoco.mj_step(model, data, 150)
        assert data.qvel[0] + mass_ratio * data.qvel[6] == pytest.approx(5.0, rel=1e-6)
        measured.append((data.qvel[6] - data.qvel[0]) / 5.0)
    assert np.mean(measured) == pytest.approx(restitution, abs=0.05)


@pytest.mark.parametrize("row", [0, 6, 12])
def test_table_is_what_the_calibration_measures(row: int):
    ratio, restitution = RESTITUTION_TABLE[row]
    assert measure_restitution(ratio)[0] == pytest.approx(restitution, abs=0.002)  # another MuJoCo may round otherwise


def test_time_constants_suit_the_timestep():
    """MuJoCo raises time constants below two timesteps (``refsafe``), which would change the restitution."""
    for restitution in np.linspace(0, 1, 21):
        time_constant, ratio = solver_reference(float(restitution))
        assert time_constant >= 2 * CALIBRATED_TIMESTEP
        assert 0 < ratio <= 1.5


def test_more_damping_bounces_less():
    ratios, restitutions = np.asarray(RESTITUTION_TABLE).T
    assert (np.diff(ratios) > 0).all() and (np.diff(restitutions) < 0).all()
