"""Distance fields of the knee's surfaces: compiled kernels.

Scene frame: x along the gap, y across it (the femur is at negative y), z away from the lens. All lengths in
metres. ``shape`` is the flat array of `KneeScene.constants`, ``waves`` its sine waves (n, 6), sorted by
surface: surface, amplitude, wave vector [cycles/m], phase [cycles]; ``probe`` the joints (k, 4) of the
probe, x y z and radius, empty if there is none.
"""

import numpy as np

from knee_gap_core.compiled import compiled
from knee_gap_core.values.arrays import Array

CONDYLE, PLATEAU, MENISCUS, CAPSULE, PROBE = 0, 1, 2, 3, 4
# Waves of a line, not a surface: height and depth of the ridge, and the free edge of the meniscus.
RIDGE_HEIGHT, RIDGE_DEPTH, FREE_EDGE = 5, 6, 7

# shape[WAVES + s] is the index in the sorted array at which the waves of surface s begin.
WAVES = 28

_C3, _C4 = -9.538676415369677, 3.077239184687607


@compiled(nogil=True)
def _sine(cycles: float) -> float:
    """Approximation of sin(2 pi cycles) within 2e-7, continuous; the ripples are defined by it."""
    r = cycles - np.round(cycles)
    s = r * r
    p = 6.28318319075165 + s * (-16.208720030796144 + s * (16.762028054508296 + s * (_C3 + s * _C4)))
    return float(r * (1.0 - 4.0 * s) * p)


@compiled(nogil=True)
def ripple(x: float, y: float, z: float, surface: int, shape: Array, waves: Array) -> float:
    """Sum of the sine waves of a surface [m]."""
    total = 0.0
    for k in range(int(shape[WAVES + surface]), int(shape[WAVES + surface + 1])):
        total += waves[k, 1] * _sine(waves[k, 2] * x + waves[k, 3] * y + waves[k, 4] * z + waves[k, 5])
    return total


@compiled(nogil=True)
def _ellipsoid(x: float, y: float, z: float, shape: Array, first: int) -> float:
    """Approximate distance to an ellipsoid (centre and radii: shape[first : first + 6]); negative inside."""
    x, y, z = x - shape[first], y - shape[first + 1], z - shape[first + 2]
    rx, ry, rz = shape[first + 3], shape[first + 4], shape[first + 5]
    k0 = np.sqrt((x / rx) ** 2 + (y / ry) ** 2 + (z / rz) ** 2)
    k1 = np.sqrt((x / (rx * rx)) ** 2 + (y / (ry * ry)) ** 2 + (z / (rz * rz)) ** 2)
    return float(k0 * (k0 - 1.0) / max(k1, 1e-9))


@compiled(nogil=True)
def condyle(x: float, y: float, z: float, shape: Array, waves: Array) -> float:
    """Distance to the femoral condyle, an ellipsoid with ripples."""
    distance = _ellipsoid(x, y, z, shape, 0)
    if distance > 2e-3:
        return distance - 0.6e-3
    return distance - ripple(x, y, z, CONDYLE, shape, waves)


@compiled(nogil=True)
def plateau(x: float, y: float, z: float, shape: Array, waves: Array) -> float:
    """Distance to the tibial plateau, which falls off in front and slopes down behind."""
    height, tilt_x, tilt_z, bend_x = shape[12], shape[13], shape[14], shape[15]
    front, fall = shape[16], shape[17]
    before = max(0.0, front - z)
    surface = height + tilt_x * x + tilt_z * z + bend_x * x * x + 0.5 * fall * before * before
    slope_x, slope_z = tilt_x + 2.0 * bend_x * x, tilt_z - fall * before
    distance = float((surface - y) / np.sqrt(1.0 + slope_x * slope_x + slope_z * slope_z))
    if distance > 2e-3:
        return distance - 0.6e-3
    return distance - ripple(x, y, z, PLATEAU, shape, waves)


@compiled(nogil=True)
def ridge(x: float, shape: Array, waves: Array) -> tuple[float, float, float, float]:
    """The sharp rim of the meniscus at x: its y and z, and their slopes along x."""
    y = shape[18] - 0.5 * shape[20] * x * x
    z = shape[19] - 0.5 * shape[21] * x * x
    dy, dz = -shape[20] * x, -shape[21] * x
    for k in range(int(shape[WAVES + RIDGE_HEIGHT]), int(shape[WAVES + FREE_EDGE])):
        cycles = waves[k, 2] * x + waves[k, 5]
        amount, change = (
            waves[k, 1] * _sine(cycles),
            2.0 * np.pi * waves[k, 1] * waves[k, 2] * _sine(cycles + 0.25),
        )
        if waves[k, 0] == RIDGE_HEIGHT:
            y, dy = y + amount, dy + change
        else:
            z, dz = z + amount, dz + change
    return y, z, dy, dz


@compiled(nogil=True)
def meniscus(x: float, y: float, z: float, shape: Array, waves: Array) -> float:
    """Distance to the meniscus: a wedge that rises from its free edge to a sharp rim, undercut behind it."""
    slope, hollow, width, undercut = shape[22], shape[23], shape[24], shape[25]
    # Far away, a bound without the waves: the wedge lies below its highest rim and before its farthest.
    above, behind = float(shape[26] - y), float(z - shape[27])
    if above > 1.5e-3 or behind > 1.5e-3:
        return max(above, behind)
    rim_y, rim_z, rim_dy, rim_dz = ridge(x, shape, waves)
    below, before = y - rim_y, rim_z - z
    falls = slope - 2.0 * hollow * before
    top = slope * before - hollow * before * before - below
    if before > 0.0:
        # The ripples fade out towards the rim, so that it stays at `ridge`.
        top -= ripple(x, 0.0, z, MENISCUS, shape, waves) * before / (before + 0.5e-3)
    along = rim_dy + falls * rim_dz
    top /= np.sqrt(1.0 + falls * falls + along * along)
    back = undercut * below - before
    along = undercut * rim_dy + rim_dz
    back /= np.sqrt(1.0 + undercut * undercut + along * along)
    edge = before - width + ripple(x, 0.0, 0.0, FREE_EDGE, shape, waves)
    return float(max(top, back, edge / np.sqrt(1.2 + 0.5 * rim_dz * rim_dz)))


@compiled(nogil=True)
def capsule(x: float, y: float, z: float, shape: Array, waves: Array) -> float:
    """Distance to the wall of the joint from inside it, rippled like synovium."""
    distance = -_ellipsoid(x, y, z, shape, 6)
    if distance > 3e-3:
        return distance - 1.5e-3
    return 0.75 * (distance - ripple(x, y, z, CAPSULE, shape, waves))


@compiled(nogil=True)
def probe_distance(x: float, y: float, z: float, probe: Array) -> float:
    """Distance to the probe, a chain of rods."""
    nearest = 1.0
    for k in range(probe.shape[0] - 1):
        ax, ay, az, ar = probe[k]
        bx, by, bz, br = probe[k + 1]
        ux, uy, uz = bx - ax, by - ay, bz - az
        share = ((x - ax) * ux + (y - ay) * uy + (z - az) * uz) / (ux * ux + uy * uy + uz * uz)
        share = min(1.0, max(0.0, share))
        dx, dy, dz = x - ax - share * ux, y - ay - share * uy, z - az - share * uz
        distance = np.sqrt(dx * dx + dy * dy + dz * dz) - (ar + share * (br - ar))
        nearest = min(nearest, distance)
    return nearest


@compiled(nogil=True)
def surface_distance(
    x: float, y: float, z: float, surface: int, shape: Array, waves: Array, probe: Array
) -> float:
    """Distance to one of the surfaces."""
    if surface == CONDYLE:
        return condyle(x, y, z, shape, waves)
    if surface == PLATEAU:
        return plateau(x, y, z, shape, waves)
    if surface == MENISCUS:
        return meniscus(x, y, z, shape, waves)
    if surface == PROBE:
        return probe_distance(x, y, z, probe)
    return capsule(x, y, z, shape, waves)


@compiled(nogil=True)
def field(x: float, y: float, z: float, shape: Array, waves: Array, probe: Array) -> tuple[float, int]:
    """Distance to the nearest surface, never more than the true one, and the index of the surface."""
    nearest, surface = condyle(x, y, z, shape, waves), CONDYLE
    distance = plateau(x, y, z, shape, waves)
    if distance < nearest:
        nearest, surface = distance, PLATEAU
    distance = meniscus(x, y, z, shape, waves)
    if distance < nearest:
        nearest, surface = distance, MENISCUS
    distance = capsule(x, y, z, shape, waves)
    if distance < nearest:
        nearest, surface = distance, CAPSULE
    if probe.shape[0] > 1:
        distance = probe_distance(x, y, z, probe)
        if distance < nearest:
            nearest, surface = distance, PROBE
    return nearest, surface


@compiled(nogil=True)
def normal(
    x: float, y: float, z: float, surface: int, shape: Array, waves: Array, probe: Array
) -> tuple[float, float, float]:
    """Unit normal of a surface, out of the tissue."""
    h = 5e-6
    a = surface_distance(x + h, y - h, z - h, surface, shape, waves, probe)
    b = surface_distance(x - h, y - h, z + h, surface, shape, waves, probe)
    c = surface_distance(x - h, y + h, z - h, surface, shape, waves, probe)
    d = surface_distance(x + h, y + h, z + h, surface, shape, waves, probe)
    nx, ny, nz = a - b - c + d, -a - b + c + d, -a + b - c + d
    scale = 1.0 / np.sqrt(nx * nx + ny * ny + nz * nz)
    return nx * scale, ny * scale, nz * scale


@compiled(nogil=True)
def distances(
    points: Array,
    surface: int,
    shape: Array,
    waves: Array,
    probe: Array,
    result: Array,
) -> None:
    """Distances (n,) of points (n, 3) to one surface, or to the nearest of all with a surface of -1."""
    for i in range(points.shape[0]):
        x, y, z = points[i]
        if surface < 0:
            result[i] = field(x, y, z, shape, waves, probe)[0]
        else:
            result[i] = surface_distance(x, y, z, surface, shape, waves, probe)


@compiled(nogil=True)
def ridge_points(along: Array, shape: Array, waves: Array, result: Array) -> None:
    """Points (n, 3) of the sharp rim of the meniscus at places (n,) along the gap."""
    for i in range(along.shape[0]):
        y, z, _, _ = ridge(along[i], shape, waves)
        result[i, 0], result[i, 1], result[i, 2] = along[i], y, z


@compiled(nogil=True)
def foot_on_condyle(point: Array, shape: Array, waves: Array, foot: Array) -> None:
    """The point (3,) of the condyle nearest to another, by sliding on the surface until it converges."""
    probe = np.zeros((0, 4))
    foot[:] = point
    for _ in range(200):
        nx, ny, nz = normal(foot[0], foot[1], foot[2], CONDYLE, shape, waves, probe)
        off = condyle(foot[0], foot[1], foot[2], shape, waves)
        dx, dy, dz = point[0] - foot[0], point[1] - foot[1], point[2] - foot[2]
        along = dx * nx + dy * ny + dz * nz
        sx, sy, sz = dx - along * nx, dy - along * ny, dz - along * nz
        foot[0] += 0.7 * sx - off * nx
        foot[1] += 0.7 * sy - off * ny
        foot[2] += 0.7 * sz - off * nz
        if sx * sx + sy * sy + sz * sz < 1e-22 and abs(off) < 1e-11:
            return
