import mujoco
import numpy as np
import pytest

from data_gen.blender.extraction import AbstractScene, Extraction, extract
from data_gen.blender.lights import linear
from tests.data_gen.blender.small_scene import CAMERA, TINT, small_scene
from vpd_lightning.errors import RenderingBackendError

CAMERA_IDS = list(range(CAMERA.num_views))


@pytest.fixture(scope="module")
def scene():
    model, data, _ = small_scene()
    return model, data, extract(AbstractScene(model), data, CAMERA_IDS)


def number_of(model, extraction: Extraction, name: str) -> int:
    return next(
        number
        for number, drawn in enumerate(extraction.drawn)
        if drawn.object_type == mujoco.mjtObj.mjOBJ_GEOM and model.geom(drawn.object_id).name == name
    )


def test_what_mujoco_would_draw_is_drawn(scene):
    model, _, extraction = scene
    names = {model.geom(d.object_id).name for d in extraction.drawn if d.object_type == mujoco.mjtObj.mjOBJ_GEOM}
    assert names == {"floor", "box", "ball", "can", "pill", "wedge"}  # not the transparent ghost, not group 3
    assert [d.object_id for d in extraction.drawn if d.object_type == mujoco.mjtObj.mjOBJ_FLEX] == [0]
    head = extraction.head
    assert len(head["objects"]) == len(head["materials"]) == len(extraction.drawn) == 7
    assert head["fovy"] == pytest.approx([np.radians(40)] * 2)
    assert head["far"] == pytest.approx(20 * model.stat.extent)


def test_arrays_fit_together(scene):
    _, _, extraction = scene
    for number, material in enumerate(extraction.head["materials"]):
        faces = extraction.arrays[f"object{number}.faces"]
        vertices = extraction.arrays[f"object{number}.vertices"]
        assert faces.dtype == np.int32 and faces.max() == len(vertices) - 1
        assert extraction.arrays[f"object{number}.normals"].shape == (faces.size, 3)
        if material["lookup"]:
            width = 2 if material["lookup"] == "uv" else 3
            assert extraction.arrays[f"object{number}.{material['lookup']}"].shape == (faces.size, width)
            assert 0 <= material["image"] < extraction.head["images"]


def test_textures_come_from_the_model_and_carry_the_materials_colour(scene):
    model, _, extraction = scene
    texture = model.texture("flat")
    start = int(texture.adr[0])
    pixels = model.tex_data[start : start + 32 * 64 * 3].reshape(32, 64, 3)
    materials = extraction.head["materials"]
    floor, can, wedge = (materials[number_of(model, extraction, name)] for name in ("floor", "can", "wedge"))
    assert np.array_equal(extraction.arrays[f"image{floor['image']}"], pixels)
    assert np.array_equal(extraction.arrays[f"image{can['image']}"], np.rint(pixels * TINT))
    assert can["image"] == wedge["image"] != floor["image"]  # same texture and colour: kept once
    box, ball = (materials[number_of(model, extraction, name)] for name in ("box", "ball"))
    assert box["lookup"] == "uv" and ball["lookup"] == "direction"
    assert extraction.arrays["sky"].shape[1] == 2 * extraction.arrays["sky"].shape[0]


def test_plain_colours_become_linear(scene):
    model, _, extraction = scene
    pill = extraction.head["materials"][number_of(model, extraction, "pill")]
    assert pill["image"] == -1
    assert pill["color"] == pytest.approx([((c + 0.055) / 1.055) ** 2.4 for c in (0.2, 0.4, 0.8)], rel=1e-5)


def test_mesh_keeps_its_own_texture_coordinates(scene):
    model, _, extraction = scene
    number = number_of(model, extraction, "wedge")
    assert np.array_equal(extraction.arrays[f"object{number}.uv"], model.mesh_texcoord[model.mesh_facetexcoord.ravel()])
    # In the world the wedge stands where its file put it: MuJoCo's shift to the centre of mass is undone by the geom.
    geom = model.geom("wedge").id
    _, data, _ = scene
    world = extraction.arrays[f"object{number}.vertices"] @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
    assert world.min(axis=0) == pytest.approx([-0.75, 0.25, 0.0], abs=1e-6)
    assert world.max(axis=0) == pytest.approx([-0.25, 0.75, 0.4], abs=1e-6)


def test_skin_is_the_fem_surface_grown_by_its_radius(scene):
    model, data, extraction = scene
    number = next(n for n, d in enumerate(extraction.drawn) if d.object_type == mujoco.mjtObj.mjOBJ_FLEX)
    corners = extraction.arrays[f"object{number}.vertices"]
    assert len(corners) == 3 * int(model.flex_shellnum[0])
    distance = np.linalg.norm(corners[:, None] - data.flexvert_xpos[None], axis=2).min(axis=1)
    assert distance == pytest.approx(0.02, abs=1e-6)


def test_floor_in_sunlight_is_as_bright_as_mujocos(scene):
    _, _, extraction = scene
    (light,) = extraction.head["lights"]
    slope = 1 / np.linalg.norm([0.4, 0.3, 1.0])
    assert light["kind"] == "sun" and light["casts_shadow"]
    received = np.array(extraction.head["ambient"]) + slope * np.array(light["strength"])
    assert received == pytest.approx(linear(np.full(3, 0.35 + 0.6 * slope)), rel=1e-5)
    assert extraction.head["ambient"] == pytest.approx(linear(np.full(3, 0.35)), rel=1e-5)


def test_dome_around_the_cameras_lets_light_in():
    model, data, _ = small_scene('<geom name="dome" type="sphere" size="10" contype="0" conaffinity="0"/>')
    extraction = extract(AbstractScene(model), data, CAMERA_IDS)
    surrounding = [o["surrounds"] for o in extraction.head["objects"]]
    assert surrounding[number_of(model, extraction, "dome")]
    assert sum(surrounding) == 1


@pytest.mark.parametrize(
    ("extra", "what"),
    [
        ('<light type="point" pos="0 0 2" diffuse="1 1 1"/>', "mjLIGHT_POINT"),
        ('<flexcomp name="rope" type="grid" dim="1" count="3 1 1" spacing=".1 .1 .1" mass="1"/>', "one-dimensional"),
    ],
)
def test_what_cannot_be_drawn_is_named(extra: str, what: str):
    model, data, _ = small_scene(extra)
    with pytest.raises(RenderingBackendError, match=what) as caught:
        extract(AbstractScene(model), data, CAMERA_IDS)
    assert "renderer=egl" in str(caught.value)
