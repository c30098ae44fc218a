import io
from pathlib import Path

import cv2
import numpy as np
import pytest

from data_gen.movi import mesh_files, user_meshes
from data_gen.movi.mesh import Mesh
from data_gen.movi.user_meshes import load_folder
from vpd_lightning.errors import DataError

trimesh = pytest.importorskip("trimesh")

# A picture of four colours, top left, top right, bottom left, bottom right; v points up.
COLORS = np.array([[[250, 10, 20], [30, 240, 10]], [[15, 25, 245], [235, 230, 5]]], dtype=np.uint8)
CORNERS = {
    (0.25, 0.75): COLORS[0, 0],
    (0.75, 0.75): COLORS[0, 1],
    (0.25, 0.25): COLORS[1, 0],
    (0.75, 0.25): COLORS[1, 1],
}


def picture(size: int = 32) -> np.ndarray:
    return np.repeat(np.repeat(COLORS, size // 2, axis=0), size // 2, axis=1)


def box() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A box 2 x 1 x 1: four corners a face, each with the whole picture."""
    vertices, texcoords, faces = [], [], []
    for axis in range(3):
        for side in (-1, 1):
            start = len(vertices)
            for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
                point = np.zeros(3)
                point[axis], point[(axis + 1) % 3], point[(axis + 2) % 3] = side, a * side, b
                vertices.append(point * [1.0, 0.5, 0.5])
                texcoords.append([(a + 1) / 2, (b + 1) / 2])
            faces += [[start, start + 1, start + 2], [start, start + 2, start + 3]]
    return np.array(vertices), np.array(texcoords), np.array(faces)


def write_obj(path: Path, texture: str | None = "pic.png") -> None:
    vertices, texcoords, faces = box()
    lines = [f"mtllib {path.stem}.mtl", "usemtl paint"]
    lines += ["v {} {} {}".format(*point) for point in vertices]
    lines += ["vt {} {}".format(*point) for point in texcoords]
    lines += ["f " + " ".join(f"{corner + 1}/{corner + 1}" for corner in face) for face in faces]
    path.write_text("\n".join(lines))
    material = "newmtl paint\nKd 0.5 0.25 1.0\n" + (f"map_Kd {texture}\n" if texture else "")
    path.with_suffix(".mtl").write_text(material)
    if texture and "/" not in texture:
        cv2.imwrite(str(path.parent / texture), picture()[..., ::-1])


def glb_mesh(**visual) -> "trimesh.Trimesh":
    from PIL import Image

    vertices, texcoords, faces = box()
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(picture()), **visual)
    look = trimesh.visual.TextureVisuals(uv=texcoords, material=material)
    return trimesh.Trimesh(vertices, faces, visual=look, process=False)


def color_at(mesh: Mesh, point: tuple[float, float, float]) -> np.ndarray:
    """The texture's colour at a point of the surface, by the barycentric coordinates of the face that holds it."""
    assert mesh.texcoords is not None and mesh.texture is not None
    for face in mesh.faces:
        a, b, c = mesh.vertices[face]
        matrix = np.stack([a, b, c], axis=1)
        weights, *_ = np.linalg.lstsq(np.vstack([matrix, np.ones(3)]), [*point, 1.0], rcond=None)
        if np.abs(matrix @ weights - point).max() < 1e-9 and weights.min() > -1e-9:
            u, v = weights @ mesh.texcoords[face]
            height, width = mesh.texture.shape[:2]
            return mesh.texture[int((1 - v) % 1.0 * height), int(u % 1.0 * width)]
    raise AssertionError(f"{point} is not on the surface")


def check_box(mesh: Mesh) -> None:
    assert mesh.is_closed and mesh.volume == pytest.approx(0.25)
    assert mesh.extents == pytest.approx([1.0, 0.5, 0.5])
    for (u, v), color in CORNERS.items():
        # The +x face: u along y, v along z; the box is 0.5 wide there.
        assert color_at(mesh, (0.5, (u - 0.5) / 2, (v - 0.5) / 2)) == pytest.approx(color, abs=2)


def test_obj_with_a_picture_is_recovered(tmp_path: Path):
    write_obj(tmp_path / "crate.obj")
    [(name, mesh)] = load_folder(tmp_path)
    assert name == "crate.obj"
    check_box(mesh)


def test_glb_with_a_picture_is_recovered(tmp_path: Path):
    glb_mesh().export(tmp_path / "crate.glb")
    [(_, mesh)] = load_folder(tmp_path)
    check_box(mesh)


def test_scan_with_its_picture_in_googles_place_is_found(tmp_path: Path):
    scan = tmp_path / "Some_Shoe"
    (scan / "meshes").mkdir(parents=True)
    (scan / "materials" / "textures").mkdir(parents=True)
    write_obj(scan / "meshes" / "model.obj")
    (scan / "meshes" / "pic.png").rename(scan / "materials" / "textures" / "pic.png")
    (scan / "meshes" / "collision_geometry.obj").write_text("not read")

    [(name, mesh)] = load_folder(tmp_path)

    assert name == "Some_Shoe/meshes/model.obj"
    check_box(mesh)


def test_plain_colour_and_tint_are_kept(tmp_path: Path):
    write_obj(tmp_path / "a.obj", texture=None)
    glb_mesh(baseColorFactor=[128, 255, 255, 255]).export(tmp_path / "b.glb")
    (_, plain), (_, tinted) = load_folder(tmp_path)
    assert color_at(plain, (0.5, 0.1, 0.1)) == pytest.approx([128, 64, 255], abs=2)
    assert color_at(tinted, (0.5, -0.125, 0.125)) == pytest.approx([125, 10, 20], abs=2)


def test_colours_of_vertices_become_a_texture(tmp_path: Path):
    sphere = trimesh.creation.icosphere(2)
    colors = np.column_stack([np.rint(127.5 * (sphere.vertices + 1)), np.full(len(sphere.vertices), 255)])
    sphere.visual = trimesh.visual.ColorVisuals(sphere, vertex_colors=colors.astype(np.uint8))
    sphere.export(tmp_path / "ball.glb")

    [(_, mesh)] = load_folder(tmp_path)

    assert mesh.is_closed
    for face in mesh.faces[::40]:
        corner = mesh.vertices[face]
        for point in (corner.mean(axis=0), 0.9 * corner[0] + 0.05 * corner[1] + 0.05 * corner[2]):
            # Read without interpolation from a fourth of the face's side (0.16 of 127 each way).
            expected = 127.5 * (2 * np.asarray(point) + 1)
            assert color_at(mesh, tuple(point)) == pytest.approx(expected, abs=20)


def test_several_materials_share_one_texture(tmp_path: Path):
    ball = trimesh.creation.icosphere(2, radius=0.2)
    ball.apply_translation([0, 0, 0.7])
    ball.visual = trimesh.visual.TextureVisuals(
        material=trimesh.visual.material.PBRMaterial(baseColorFactor=[10, 200, 30, 255])
    )
    trimesh.Scene([glb_mesh(), ball]).export(tmp_path / "both.glb")

    [(_, mesh)] = load_folder(tmp_path)

    assert mesh.extents == pytest.approx([1.0, 0.5, 0.7])
    shift = -0.1  # the middle of the bounding box lies 0.2 of 2 higher than that of the box
    for (u, v), color in CORNERS.items():
        assert color_at(mesh, (0.5, (u - 0.5) / 2, (v - 0.5) / 2 + shift)) == pytest.approx(color, abs=3)
    top = mesh.vertices[np.argmax(mesh.vertices[:, 2])]
    assert color_at(mesh, tuple(top)) == pytest.approx([10, 200, 30], abs=3)


def test_order_and_digest_depend_on_content_only(tmp_path: Path):
    for folder, names in (("one", ("b", "a", "c")), ("two", ("c", "b", "a"))):
        (tmp_path / folder).mkdir()
        for name in names:
            write_obj(tmp_path / folder / f"{name}.obj")
    one, two = load_folder(tmp_path / "one"), load_folder(tmp_path / "two")
    assert one.paths == two.paths == ("a.obj", "b.obj", "c.obj")
    assert one.sha256() == two.sha256() and len(one.sha256()) == 64
    (tmp_path / "two" / "pic.png").write_bytes((tmp_path / "two" / "pic.png").read_bytes() + b"\0")
    assert one.sha256() != two.sha256()
    one.check()
    assert len(one[1:]) == 2 and one[1:][0][0] == "b.obj"


def test_big_mesh_is_reduced_and_keeps_shape_and_colours(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    from PIL import Image

    monkeypatch.setattr(user_meshes, "MAX_FACES", 1500)
    sphere = trimesh.creation.uv_sphere(count=[80, 80])
    texcoords = 0.5 + 0.5 * sphere.vertices[:, [1, 2]]
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(picture()))
    sphere.visual = trimesh.visual.TextureVisuals(uv=texcoords, material=material)
    sphere.export(tmp_path / "ball.glb")
    assert len(sphere.faces) > 8000

    [(_, mesh)] = load_folder(tmp_path)

    assert 500 < len(mesh.faces) <= 1500
    assert mesh.is_closed
    assert mesh.volume == pytest.approx(np.pi / 6, rel=0.03)
    assert mesh.texcoords is not None
    assert mesh.texcoords == pytest.approx(0.5 + mesh.vertices[:, [1, 2]], abs=0.03)


def test_inside_out_mesh_is_turned(tmp_path: Path):
    vertices, _, faces = box()
    trimesh.Trimesh(vertices, faces[:, ::-1], process=False).export(tmp_path / "crate.glb")
    [(_, mesh)] = load_folder(tmp_path)
    assert mesh.volume == pytest.approx(0.25)


def broken(path: Path, content: str | bytes) -> DataError:
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(DataError) as caught:
        load_folder(path.parent).check()
    assert path.name in str(caught.value) and len(str(caught.value).splitlines()) <= 3
    return caught.value


def test_broken_meshes_are_named(tmp_path: Path):
    good = io.BytesIO(glb_mesh().export(file_type="glb")).getvalue()
    flat = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3\nf 1 3 4\n"
    solid = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    broken(tmp_path / "a" / "cut.glb", good[: len(good) // 2])
    broken(tmp_path / "b" / "noise.glb", np.random.default_rng(0).bytes(500))
    broken(tmp_path / "c" / "empty.obj", "")
    broken(tmp_path / "d" / "points.obj", "v 0 0 0\nv 1 0 0\n")
    broken(tmp_path / "e" / "strange.obj", solid + "f 1 2 99\n")
    assert "flat" in str(broken(tmp_path / "f" / "paper.obj", flat))
    broken(tmp_path / "g" / "nan.obj", solid.replace("v 0 0 1", "v 0 0 nan"))
    broken(tmp_path / "h" / "dot.obj", "v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n")


def test_limits_are_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    good = glb_mesh().export(file_type="glb")
    monkeypatch.setattr(mesh_files, "MAX_READ_FACES", 11)
    assert "at most 11" in str(broken(tmp_path / "a" / "crate.glb", good))
    monkeypatch.setattr(mesh_files, "MAX_BYTES", 1000)
    assert "MiB" in str(broken(tmp_path / "b" / "crate.glb", good))


def test_pictures_outside_of_the_folder_are_not_read(tmp_path: Path):
    cv2.imwrite(str(tmp_path / "secret.png"), picture())
    inside = tmp_path / "meshes"
    inside.mkdir()
    for name in ("../secret.png", str(tmp_path / "secret.png"), "linked.png"):
        write_obj(inside / "crate.obj", texture=name if "/" in name else None)
        if "/" not in name:
            (inside / name).symlink_to(tmp_path / "secret.png")
            (inside / "crate.mtl").write_text(f"newmtl paint\nmap_Kd {name}\n")
        with pytest.raises(DataError, match="outside of the folder"):
            load_folder(inside).check()


def test_missing_and_undecodable_pictures_are_said(tmp_path: Path):
    write_obj(tmp_path / "crate.obj")
    (tmp_path / "pic.png").unlink()
    with pytest.raises(DataError, match="pic.png"):
        load_folder(tmp_path).check()
    (tmp_path / "pic.png").write_bytes(b"no picture")
    with pytest.raises(DataError, match="decoded"):
        load_folder(tmp_path).check()

    (tmp_path / "crate.obj").unlink()
    content = glb_mesh().export(file_type="glb")
    (tmp_path / "crate.glb").write_bytes(content.replace(b"\x89PNG", b"\x89PNX"))
    with pytest.raises(DataError, match="decoded"):
        load_folder(tmp_path).check()


def test_folder_without_meshes_says_what_belongs_there(tmp_path: Path):
    with pytest.raises(DataError, match=".obj or .glb"):
        load_folder(tmp_path)
    with pytest.raises(DataError, match="not a folder"):
        load_folder(tmp_path / "nowhere")
    outside = tmp_path / "outside"
    outside.mkdir()
    write_obj(outside / "crate.obj")
    inside = tmp_path / "inside"
    inside.mkdir()
    (inside / "crate.obj").symlink_to(outside / "crate.obj")
    with pytest.raises(DataError, match="no meshes"):
        load_folder(inside)
