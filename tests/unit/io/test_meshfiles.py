import numpy as np
import pytest
import trimesh

from nbavatar.errors import DataError
from nbavatar.io.meshfiles import read_mesh_file

SEAM = """# two quads and a triangle with a texture seam, a vertex that no face uses, all ways to write a corner
v 0.1 0.2 0.30000001192092896
v 1 0 0 1.0
v 1e0 1 0
v 0 1 0
v 9 9 9
v 0.5 2 -7e-3
vt 0 0
vt 1 0
vt 1 1
vn 0 0 1
f 1/1 2/2 3/3 4/1
f 3//1 6//1 4//1
f -6/1/1 -5/2/1 -1/3/1
l 1 2
"""


def test_obj_keeps_all_vertices_in_their_order(tmp_path):
    path = tmp_path / "a.obj"
    path.write_text(SEAM)
    verts, faces = read_mesh_file(path)
    assert verts.shape == (6, 3) and verts[0, 2] == 0.30000001192092896 and verts[4].tolist() == [9, 9, 9]
    assert faces.tolist() == [[0, 1, 2], [0, 2, 3], [2, 5, 3], [0, 1, 5]]


def test_obj_with_a_texture_seam_is_what_trimesh_reads(tmp_path):
    sphere = trimesh.creation.icosphere(1)
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in sphere.vertices.tolist()] + ["vt 0 0", "vt 1 0", "vt 0 1"]
    lines += [f"f {a}/1 {b}/{2 + a % 2} {c}/{1 + b % 3}" for a, b, c in (sphere.faces + 1).tolist()]
    (tmp_path / "a.obj").write_text("\n".join(lines))
    verts, faces = read_mesh_file(tmp_path / "a.obj")
    oracle = trimesh.load(tmp_path / "a.obj", process=False, maintain_order=True, force="mesh")
    np.testing.assert_array_equal(verts[faces], oracle.vertices[oracle.faces])


def test_ids_that_count_backwards_count_from_their_line(tmp_path):
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -2 -1\n"
    (tmp_path / "a.obj").write_text(corners + corners)
    assert read_mesh_file(tmp_path / "a.obj")[1].tolist() == [[0, 1, 2], [3, 4, 5]]


@pytest.mark.parametrize("encoding", ["ascii", "binary"])
def test_ply(tmp_path, encoding):
    verts = np.random.default_rng(0).normal(size=(7, 3)).astype(np.float32)
    faces = np.array([[0, 1, 2], [2, 1, 5], [0, 5, 1]])  # vertices 3, 4, 6 are nowhere
    mesh = trimesh.Trimesh(verts, faces, process=False)
    (tmp_path / "a.ply").write_bytes(mesh.export(file_type="ply", encoding=encoding))
    found, corners = read_mesh_file(tmp_path / "a.ply")
    # trimesh writes text with eight decimals.
    np.testing.assert_allclose(found, verts, rtol=0, atol=1e-8 if encoding == "ascii" else 0)
    np.testing.assert_array_equal(corners, faces)


BAD = {
    "a.obj": (b"v 1 2\nf 1 1 1\n", "expected an OBJ mesh"),
    "b.obj": (b"v 1 2 3\nf 1 2 3\n", "faces: expected vertices 0 to 0, found 0 to 2"),
    "c.obj": (b"v 1 2 3\nv nan 0 0\nv 0 1 0\nf 1 2 3\n", "NaN or infinity at vertex 1"),
    "d.obj": (b"\x00\xff" * 50, "expected vertices and faces, found 0 vertices"),
    "e.obj": (b"v 1 2 3\nf 1 x 3\n", "expected an OBJ mesh"),
    "f.obj": (b"v 1 2 3\nf 0 1 1\n", "faces: expected vertices 0 to 0"),
    "g.ply": (b"ply\nformat ascii 1.0\nelement vertex 9\n", "expected a PLY mesh"),
    "h.ply": (b"", "expected a PLY mesh"),
    "i.stl": (b"solid", "expected a mesh (.obj or .ply)"),
}


@pytest.mark.parametrize("name", BAD)
def test_damaged_meshes_are_named(tmp_path, name):
    content, line = BAD[name]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(DataError) as caught:
        read_mesh_file(tmp_path / name)
    assert name in str(caught.value) and line in str(caught.value)


def test_no_file(tmp_path):
    with pytest.raises(DataError, match="no such file"):
        read_mesh_file(tmp_path / "none.obj")
