"""A knee of meshes: two ellipsoids over a slab whose truth is known, and meshes that make no knee."""

import struct
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("trimesh", reason="make anatomy")
pytest.importorskip("embreex", reason="make anatomy")

from knee_gap_core.bag.bag import BagReader
from knee_gap_core.values.rigid_transforms import inverse
from knee_gap_simulation.anatomy.mesh_knee import MeshKnee
from knee_gap_simulation.anatomy.meshes import Surface, read_meshes
from knee_gap_simulation.anatomy.posing import Compartment
from knee_gap_simulation.errors import SimulationError
from knee_gap_simulation.knee.ground_truth import Visibility
from knee_gap_simulation.knee_simulator import Anatomy, KneeSimulator
from knee_gap_simulation.make_bag.command import main
from knee_gap_simulation.recordings.scene_truth import scene_from_metadata
from knee_gap_simulation.surfaces.distance_field import CONDYLE, PLATEAU

RADII = np.array([0.020, 0.019, 0.011])  # forward, up, to the right
PERSON = Path(__file__).parents[4] / "shared/data/anatomy"


def ellipsoid(centre, rings=60):
    u, v = np.meshgrid(np.linspace(0, np.pi, rings), np.linspace(0, 2 * np.pi, 2 * rings, endpoint=False))
    unit = np.stack([np.cos(u), np.sin(u) * np.cos(v), np.sin(u) * np.sin(v)], axis=-1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(2 * rings), np.arange(rings - 1), indexing="ij")
    a, b = (i * rings + j).ravel(), ((i + 1) % (2 * rings) * rings + j).ravel()
    faces = np.concatenate([np.stack([a, a + 1, b + 1], -1), np.stack([a, b + 1, b], -1)])
    return clean(centre + RADII * unit, faces)


def clean(vertices, faces):
    vertices, index = np.unique(np.round(vertices, 9), axis=0, return_inverse=True)
    faces = index.reshape(-1)[faces]
    a, b, c = faces.T
    return Surface(vertices, faces[(a != b) & (b != c) & (c != a)])


def slab(low, high):
    x, y, z = np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij")
    corners = np.stack([x, y, z], -1).reshape(-1, 3)
    faces = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]]
    faces += [[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
    low, high = np.array(low), np.array(high)
    return Surface(low + (high - low) * corners, np.array(faces))


def write(path, surface, scale=1.0):
    corners = (scale * surface.corners).astype("<f4")
    with path.open("wb") as file:
        file.write(b"\0" * 80 + struct.pack("<I", len(corners)))
        for triangle in corners:
            file.write(struct.pack("<12fH", 0, 0, 0, *triangle.ravel(), 0))


def femur():
    return Surface.joined([ellipsoid(np.array([0.0, 0.0, side * 0.021])) for side in (-1, 1)])


TIBIA = slab((-0.009, -0.032, -0.036), (0.024, -0.022, 0.036))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("knee")
    write(path / "femur.stl", femur())
    write(path / "tibia.stl", TIBIA)
    return path


@pytest.fixture(scope="module")
def knee(folder):
    return MeshKnee(folder, "m", Compartment.MEDIAL, 0.3, 0.004)


@pytest.mark.parametrize(("compartment", "gap"), [("medial", 0.004), ("lateral", 0.0025)])
def test_the_chosen_compartment_opens_to_what_was_asked(folder, compartment, gap):
    opened = MeshKnee(folder, "m", Compartment(compartment), 0.3, gap)
    distance, above, below = opened.nearest_distance()
    assert distance == pytest.approx(gap, abs=3e-6)
    assert np.linalg.norm(above - below) == pytest.approx(distance)
    assert np.degrees(opened.tilt) == pytest.approx(np.degrees(gap / 0.042), rel=0.35)
    assert opened.distance(above)[0] == pytest.approx(0.0, abs=3e-5)


def test_rays_end_on_the_surfaces(knee):
    rng = np.random.default_rng(1)
    origin = np.array([0.0, 0.0, -0.014])
    directions = np.array([0.0, 0.0, 1.0]) + 0.6 * rng.uniform(-1, 1, (400, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    points, normals, surfaces, lengths = knee.cast(origin, directions)
    on_slab = surfaces == PLATEAU
    assert on_slab.sum() > 50
    assert (surfaces == CONDYLE).sum() > 50
    top = points[on_slab & (normals[:, 1] < -0.99), 1]
    np.testing.assert_allclose(top, top[0], atol=1e-9)
    np.testing.assert_allclose(points, origin + lengths[:, None] * directions)
    assert np.abs(knee.distance(points)).max() < 0.25e-3
    assert (np.einsum("ij,ij->i", normals, directions) <= 1e-9).all()


@pytest.fixture(scope="module")
def view(folder):
    anatomy = Anatomy(folder, flexion=0.3)
    simulator = KneeSimulator(0, 3, gap=0.004, depth=0.012, anatomy=anatomy, duration_s=0.1)
    return simulator, next(simulator.frames(0, 1))


def test_edges_and_instrument_of_a_section(view):
    simulator, frame = view
    rows, columns = np.nonzero(frame.gap_mask)
    assert len(rows) > 3000
    T_scene_lens = inverse(simulator.T_world_scene) @ frame.T_world_lens
    middle = simulator.lens.pixels(-T_scene_lens[:3, :3].T @ T_scene_lens[:3, 3])
    nearest = np.argmin((columns - middle[0]) ** 2 + (rows - middle[1]) ** 2)
    pixel = [columns[nearest], rows[nearest]]
    edges = simulator.edges_at_section(frame, pixel)
    assert np.isfinite(edges).all()
    # The thickest instrument passes near the narrowest place, between the edges.
    diameter = simulator.instrument_gap(frame, edges).diameter
    assert 0.0039 < diameter < 0.0065
    points = simulator.points(frame, [pixel, [640.0, 80.0]])
    seen = simulator.follow(points, frame, edges=False)
    np.testing.assert_allclose(
        seen.pixels[seen.visible], np.array([pixel, [640.0, 80.0]])[seen.visible], atol=1e-6
    )
    assert seen.visible.any()


def test_what_lies_behind_the_condyle_is_hidden(view):
    simulator, frame = view
    points = simulator.points(frame, [[640.0, 80.0]])
    assert points.surfaces[0] == CONDYLE
    behind = points._replace(
        points=points.points + 0.002 * (points.points - frame.T_world_lens[:3, 3]) / 0.012
    )
    assert simulator.follow(behind, frame, edges=False).visibility[0] == Visibility.BEHIND_TISSUE


def test_a_bag_restores_its_truth_and_notices_other_meshes(folder, tmp_path, capsys):
    arguments = (
        f"--anatomy {folder} --gap-mm 4 --depth-mm 12 --duration-s 0.1 --fps 10 --travel-mm 2 --seed 3"
    )
    assert main([str(tmp_path / "bag"), *arguments.split()]) == 0, capsys.readouterr().err
    with BagReader(tmp_path / "bag") as reader:
        metadata = dict(reader.metadata)
    truth = scene_from_metadata(metadata)
    assert isinstance(truth.scene, MeshKnee)
    assert truth.scene.gap == 0.004
    text = metadata["knee_gap_simulation"].replace(truth.scene.digest, "0" * 64)
    with pytest.raises(SimulationError, match="not those of the bag"):
        scene_from_metadata({"knee_gap_simulation": text})


def holed(surface):
    normals = surface.corners.mean(axis=1) - surface.vertices.mean(axis=0)
    up, front = np.argmax(normals[:, 1]), np.argmax(normals[:, 0])
    return Surface(surface.vertices, np.delete(surface.faces, [up, front], axis=0))


def moved(forward, up):
    surface = femur()
    return Surface(surface.vertices + np.array([forward, up, 0.0]), surface.faces)


BAD = {
    "empty": (Surface(np.zeros((3, 3)), np.array([[0, 1, 2]])), 1.0, "is empty"),
    "millimetres": (femur(), 1e3, "is in millimetres by its size: add --mesh-unit mm"),
    "inside out": (femur()._replace(faces=femur().faces[:, ::-1]), 1.0, "is inside out"),
    "apart": (moved(0.09, 0.0), 1.0, "do not overlap along x"),
    "below": (moved(0.0, -0.09), 1.0, "does not lie above"),
    "holes": (holed(femur()), 1.0, "has 1 hole: close"),
    "tiny": (femur(), 0.1, "no femur"),
}


@pytest.mark.parametrize("kind", BAD)
def test_meshes_that_make_no_knee_are_refused_in_one_line(tmp_path, capsys, kind):
    surface, scale, message = BAD[kind]
    write(tmp_path / "femur.stl", surface, scale)
    write(tmp_path / "tibia.stl", TIBIA, scale)
    assert main([str(tmp_path / "bag"), "--anatomy", str(tmp_path)]) == 1
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert message in lines[0]
    assert not (tmp_path / "bag").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--anatomy {folder}/none", "is no folder of meshes"),
        ("--anatomy {folder} --gap-mm 11.9", "cannot be opened to 11.9 mm"),
        ("--anatomy {folder} --flexion-deg 170", "flexion must lie in [0, 130] degrees"),
        ("--compartment lateral", "are for --anatomy"),
        ("--anatomy {folder}/empty", "holds no mesh (STL, PLY, OBJ) whose name contains 'femur'"),
    ],
)
def test_what_cannot_be_done_is_one_line(folder, tmp_path, capsys, arguments, message):
    (folder / "empty").mkdir(exist_ok=True)
    assert main([str(tmp_path / "bag"), *arguments.format(folder=folder).split()]) == 1
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert message in lines[0]


def test_millimetres_are_read_if_they_are_said(tmp_path):
    write(tmp_path / "femur.stl", femur(), 1e3)
    write(tmp_path / "tibia.stl", TIBIA, 1e3)
    assert np.ptp(read_meshes(tmp_path, "mm").femur.vertices[:, 2]) == pytest.approx(0.064, abs=1e-4)


@pytest.mark.skipif(not PERSON.is_dir(), reason="no ../shared/data/anatomy")
def test_a_persons_knee_opens(capsys):
    opened = MeshKnee(PERSON, "m", Compartment.LATERAL, np.radians(25.0), 0.004)
    assert opened.nearest_distance()[0] == pytest.approx(0.004, abs=5e-6)
    assert np.degrees(opened.tilt) < 10.0
