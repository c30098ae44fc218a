import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from data_gen import gl_backend
from data_gen.movi.mesh import Mesh, join
from data_gen.movi.mesh_xml import mesh_xml, paint, part_attributes, texture_xml
from data_gen.movi.shapes import SHAPES, collision_parts, shape_mesh
from data_gen.movi.stand_ins import stand_in
from data_gen.movi.sweeps import revolution, tube, voxel_mesh
from data_gen.worker import environment

ROOT = Path(__file__).resolve().parents[3]


def box(*sides: float) -> Mesh:
    return Mesh(
        voxel_mesh(np.ones((1, 1, 1), dtype=bool)).vertices * sides, voxel_mesh(np.ones((1, 1, 1), dtype=bool)).faces
    )


def test_box_is_measured_exactly():
    mesh = box(2.0, 3.0, 4.0)

    assert mesh.is_closed
    assert mesh.volume == pytest.approx(24.0, rel=1e-12)
    assert mesh.area == pytest.approx(52.0, rel=1e-12)
    normal = mesh.normalized()
    assert normal.bounds == pytest.approx(np.array([[-0.25, -0.375, -0.5], [0.25, 0.375, 0.5]]))
    assert mesh.normalized(longest=2.0).extents == pytest.approx([1.0, 1.5, 2.0])


def test_missing_or_turned_face_is_not_closed():
    mesh = box(1.0, 1.0, 1.0)
    turned = mesh.faces.copy()
    turned[3] = turned[3][::-1]

    assert not Mesh(mesh.vertices, mesh.faces[1:]).is_closed
    assert not Mesh(mesh.vertices, turned).is_closed
    assert Mesh(mesh.vertices, mesh.faces[:, ::-1]).volume == pytest.approx(-1.0)


def test_creases_keep_their_edges_and_round_bodies_stay_smooth():
    flat = box(1.0, 1.0, 1.0).shaded(crease=40.0)
    assert len(flat.vertices) == 24  # three normals at each corner
    assert flat.normals is not None
    assert np.abs(flat.normals).max(axis=1) == pytest.approx(1.0)
    assert flat.is_closed and flat.volume == pytest.approx(1.0)

    angle = 2 * np.pi * np.arange(64) / 64
    ring = tube(np.stack([2 * np.cos(angle), 2 * np.sin(angle), 0 * angle], axis=1), 0.5, 32).shaded(crease=40.0)
    assert ring.normals is not None and len(ring.vertices) == 64 * 32
    center = ring.vertices * [1, 1, 0]
    center *= 2 / np.linalg.norm(center, axis=1, keepdims=True)
    # A normal of a polygon with 64 x 32 corners against the torus's own: well within half a face's angle.
    assert ring.normals == pytest.approx((ring.vertices - center) / 0.5, abs=0.02)


def test_shading_is_smooth_across_the_seam_of_a_texture():
    mesh = revolution([(0, -1), (1, -1), (1, 1), (0, 1)], 24).shaded(crease=40.0)
    assert mesh.texcoords is not None and mesh.normals is not None
    assert mesh.is_closed

    side = np.abs(mesh.normals[:, 2]) < 0.5
    radial = mesh.vertices[side] * [1, 1, 0]
    assert mesh.normals[side] == pytest.approx(radial, abs=1e-3)  # seam (angle 0) and all others alike
    at_seam = side & np.isclose(mesh.vertices[:, 0], 1.0) & np.isclose(mesh.vertices[:, 1], 0.0, atol=1e-9)
    assert set(mesh.texcoords[at_seam, 0]) == {0.0, 1.0}


def test_joined_meshes_keep_volume_and_texture_coordinates():
    first, second = (revolution([(0, 0), (1, 0), (0, 1)], 12), box(1, 1, 1))
    assert join([first, second]).volume == pytest.approx(first.volume + 1.0)
    assert join([first, second]).texcoords is None
    assert join([first, first]).texcoords is not None


def test_mujoco_puts_meshes_and_collision_parts_where_they_are():
    import mujoco

    for name in SHAPES:
        mesh, parts = shape_mesh(name).scaled(1.4), [part.scaled(1.4) for part in collision_parts(name)]
        assets = mesh_xml("seen", mesh) + "".join(
            mesh_xml(f"part{i}", part.mesh) for i, part in enumerate(parts) if part.mesh is not None
        )
        geoms = "".join(f"<geom {part_attributes(part, f'part{i}')}/>" for i, part in enumerate(parts))
        model = mujoco.MjModel.from_xml_string(
            f"<mujoco><asset>{assets}</asset><worldbody><body><freejoint/>"
            f'<geom type="mesh" mesh="seen" contype="0" conaffinity="0"/>{geoms}</body></worldbody></mujoco>'
        )
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)

        start, count = int(model.mesh_vertadr[model.mesh("seen").id]), int(model.mesh_vertnum[model.mesh("seen").id])
        local = model.mesh_vert[start : start + count].astype(np.float64)
        world = local @ data.geom_xmat[0].reshape(3, 3).T + data.geom_xpos[0]
        # MuJoCo stores single precision and may drop or reorder duplicates; the bounds stay.
        assert np.stack([world.min(axis=0), world.max(axis=0)]) == pytest.approx(mesh.bounds, abs=1e-5)


_PICTURE = """
import sys
import mujoco
import numpy as np
from data_gen.movi.mesh_xml import mesh_xml, paint, texture_xml
from tests.data_gen.movi.test_mesh import painted_square
mesh = painted_square()
model = mujoco.MjModel.from_xml_string(f'''<mujoco>
<visual><headlight ambient="1 1 1" diffuse="0 0 0" specular="0 0 0"/></visual>
<asset>{texture_xml("t", mesh.texture)}{mesh_xml("m", mesh)}<material name="m" texture="t" specular="0"/></asset>
<worldbody><geom type="mesh" mesh="m" material="m"/>
<camera name="c" pos="0 0 3" fovy="20"/></worldbody></mujoco>''')
paint(model, "t", mesh.texture)
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
renderer = mujoco.Renderer(model, 64, 64)
renderer.update_scene(data, "c")
picture = renderer.render()
for row, column in ((20, 20), (20, 44), (44, 20), (44, 44)):
    print(*picture[row, column])
renderer.close()
"""


def painted_square() -> Mesh:
    """A box whose +z face shows a picture with four colours, its top towards +y; the other faces show its middle."""
    flat = box(1.0, 1.0, 0.2).centered().shaded()
    assert flat.normals is not None
    texture = np.zeros((32, 32, 3), dtype=np.uint8)
    texture[:16, :16], texture[:16, 16:] = (255, 0, 0), (0, 255, 0)
    texture[16:, :16], texture[16:, 16:] = (0, 0, 255), (255, 255, 0)
    on_top = flat.normals[:, 2:] > 0.5
    texcoords = np.where(on_top, flat.vertices[:, :2] + 0.5, 0.5)
    return Mesh(flat.vertices, flat.faces, texcoords, texture, flat.normals)


@pytest.mark.gl
def test_texture_appears_upright_and_unmirrored():
    backend = gl_backend.working_backend()
    if backend is None:
        pytest.skip("no GL here")
    import os

    command = [sys.executable, "-c", _PICTURE]
    paths = {"PYTHONPATH": f"{ROOT / 'src'}:{ROOT}"}
    done = subprocess.run(
        command, env={**os.environ, **environment(backend), **paths}, capture_output=True, text=True, check=True
    )
    colors = np.array([line.split() for line in done.stdout.splitlines()], dtype=int)

    assert colors == pytest.approx(np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 0]]), abs=3)


def test_texture_of_another_size_is_refused():
    import mujoco

    mesh = stand_in(0)
    assert mesh.texture is not None
    model = mujoco.MjModel.from_xml_string(f"<mujoco><asset>{texture_xml('t', mesh.texture)}</asset></mujoco>")

    paint(model, "t", mesh.texture)

    assert np.array_equal(model.tex_data[: mesh.texture.size], mesh.texture.reshape(-1))
    with pytest.raises(ValueError, match="is 128x128x3"):
        paint(model, "t", mesh.texture[:64])
