import hashlib

import numpy as np
import pytest

from data_gen.movi.collision_parts import hull
from data_gen.movi.mesh import Mesh
from data_gen.movi.stand_ins import FAMILIES, NUM_STAND_INS, family, stand_in

SAMPLE = range(0, NUM_STAND_INS, 26)  # 40 of them


def digest(mesh: Mesh) -> str:
    assert mesh.texcoords is not None and mesh.texture is not None and mesh.normals is not None
    parts = (mesh.vertices, mesh.faces, mesh.texcoords, mesh.texture, mesh.normals)
    return hashlib.sha256(b"".join(part.tobytes() for part in parts)).hexdigest()


def test_stand_ins_are_closed_textured_and_inside_of_their_hull():
    for index in SAMPLE:
        mesh = stand_in(index)
        assert mesh.is_closed, index
        assert mesh.volume > 1e-4, index
        assert mesh.extents.max() == pytest.approx(1.0) and np.abs(mesh.bounds.mean(axis=0)).max() < 1e-12
        assert mesh.extents.min() > 0.03, index
        assert 200 <= len(mesh.faces) <= 2000, index
        assert mesh.texture is not None and mesh.texture.shape == (128, 128, 3)
        assert mesh.texture.std(axis=(0, 1)).max() > 3, index  # not one plain colour
        assert mesh.texcoords is not None and mesh.texcoords.shape == (len(mesh.vertices), 2)
        part = hull(mesh.vertices)
        assert part.mesh is not None
        assert part.distance(mesh.vertices).max() < 1e-9
        assert part.mesh.volume >= mesh.volume * (1 - 1e-9)


def test_same_number_gives_the_same_bytes_and_others_differ():
    first = [digest(stand_in(index)) for index in SAMPLE]
    second = [digest(stand_in(index)) for index in reversed(SAMPLE)][::-1]
    assert first == second
    assert len(set(first)) == len(first)


def test_every_family_is_there_in_its_share():
    names = [family(index) for index in range(NUM_STAND_INS)]
    counts = {name: names.count(name) for name in FAMILIES}
    assert NUM_STAND_INS == 1033
    assert min(counts.values()) > 40
    assert max(counts.values()) < 300


def test_texture_follows_the_surface_around_a_bottle():
    index = next(i for i in range(NUM_STAND_INS) if family(i) == "bottle")
    mesh = stand_in(index)
    assert mesh.texcoords is not None and mesh.normals is not None
    side = (np.hypot(mesh.vertices[:, 0], mesh.vertices[:, 1]) > 0.05) & (mesh.texcoords[:, 0] < 1.0)
    angle = np.arctan2(mesh.vertices[side, 1], mesh.vertices[side, 0]) / (2 * np.pi) % 1.0
    # u runs with the angle, counter-clockwise seen from above: to the right for whoever stands before it.
    assert np.abs((mesh.texcoords[side, 0] - angle + 0.5) % 1.0 - 0.5).max() < 1e-6


def test_numbers_outside_are_refused():
    for index in (-1, NUM_STAND_INS):
        with pytest.raises(ValueError, match="0 to 1032"):
            stand_in(index)
