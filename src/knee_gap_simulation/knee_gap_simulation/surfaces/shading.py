"""Shading of wet tissue under the light at the scope's tip."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from knee_gap_core.compiled import compiled
from knee_gap_core.values.arrays import Array
from knee_gap_simulation.surfaces.textures import PERIOD

FloatImage = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Light:
    """The light at the tip: a small lamp beside the lens, brightest straight ahead.

    ``position`` [m] is in the lens frame. ``spread`` is the exponent of the cosine with which it falls off
    to the side. ``reference`` [m] is the distance of unit irradiance; ``absorption`` [1/m] of the fluid dims
    distant tissue, on the way there and back; ``ambient`` is the light scattered by the joint.
    ``glare`` scales the specular reflection of the wet surface, ``shininess`` is its exponent, ``glint`` its
    scattering by the relief, ``sheen`` the fraction of its wide part. ``facing_exponent`` < 1 makes slanted
    surfaces brighter than Lambert's law, as subsurface scattering does in cartilage.
    """

    position: tuple[float, float, float] = (0.0004, -0.0014, -0.0002)
    spread: float = 1.5
    reference: float = 0.010
    absorption: float = 6.0
    glare: float = 0.7
    shininess: float = 140.0
    ambient: float = 0.004
    glint: float = 1.0
    sheen: float = 0.0
    facing_exponent: float = 1.0


def shade(
    points: Array,
    normals: Array,
    uv: Array,
    surfaces: npt.NDArray[np.uint8],
    textures: FloatImage,
    T_scene_lens: Array,
    light: Light,
    reach: Array | None = None,
) -> FloatImage:
    """Linear radiance (n, 3), blue green red, of surface points seen from the lens.

    points, normals: (n, 3) in the scene frame; uv: (n, 2) [m] on the surface; surfaces: (n,) index into
    ``textures`` (k, size, size, channels), NOTHING if the ray hit nothing; reach: (n, 2) fractions of the
    lamp's light and of the ambient light that reach the points (1 by default).
    """
    eye = T_scene_lens[:3, 3]
    lamp = T_scene_lens[:3, :3] @ np.asarray(light.position) + eye
    constants = np.array(
        [
            *(light.spread, light.reference, light.absorption, light.glare, light.shininess),
            *(light.ambient, light.glint, light.sheen, light.facing_exponent),
        ]
    )
    result = np.empty((len(points), 3), np.float32)
    axis = np.ascontiguousarray(T_scene_lens[:3, 2])
    if reach is None:
        reach = np.ones((len(points), 2))
    _shade(points, normals, uv, surfaces, textures, reach, eye, lamp, axis, constants, result)
    return result


NOTHING = np.uint8(255)


@compiled(nogil=True)
def _shade(
    points: Array,
    normals: Array,
    uv: Array,
    surfaces: npt.NDArray[np.uint8],
    textures: FloatImage,
    reach: Array,
    eye: Array,
    lamp: Array,
    axis: Array,
    constants: Array,
    result: FloatImage,
) -> None:
    spread, reference, absorption, glare, shininess, ambient, glint, sheen, exponent = constants
    size = textures.shape[1]
    texel = np.empty(textures.shape[3])
    for i in range(len(points)):
        if surfaces[i] == 255:
            result[i, 0] = result[i, 1] = result[i, 2] = 0.0
            continue
        _sample(textures[surfaces[i]], uv[i, 0] / PERIOD * size, uv[i, 1] / PERIOD * size, texel)
        px, py, pz = points[i]
        nx, ny, nz = normals[i]
        # Tangents of the relief: u follows the scene's x, v completes the frame.
        ux, uy, uz = 1.0 - nx * nx, -nx * ny, -nx * nz
        scale = 1.0 / max(1e-6, np.sqrt(ux * ux + uy * uy + uz * uz))
        ux, uy, uz = ux * scale, uy * scale, uz * scale
        vx, vy, vz = ny * uz - nz * uy, nz * ux - nx * uz, nx * uy - ny * ux
        bx = nx - texel[3] * ux - texel[4] * vx
        by = ny - texel[3] * uy - texel[4] * vy
        bz = nz - texel[3] * uz - texel[4] * vz
        scale = 1.0 / np.sqrt(bx * bx + by * by + bz * bz)
        bx, by, bz = bx * scale, by * scale, bz * scale

        lx, ly, lz = lamp[0] - px, lamp[1] - py, lamp[2] - pz
        to_light = np.sqrt(lx * lx + ly * ly + lz * lz)
        lx, ly, lz = lx / to_light, ly / to_light, lz / to_light
        ex, ey, ez = eye[0] - px, eye[1] - py, eye[2] - pz
        to_eye = np.sqrt(ex * ex + ey * ey + ez * ez)
        ex, ey, ez = ex / to_eye, ey / to_eye, ez / to_eye

        ahead = max(0.0, -(lx * axis[0] + ly * axis[1] + lz * axis[2]))
        beam = ahead**spread * (reference / to_light) ** 2 * np.exp(-absorption * (to_light + to_eye))
        beam *= reach[i, 0]
        # Light that scatters under the surface reaches a little beyond the terminator.
        facing = max(0.0, (bx * lx + by * ly + bz * lz + 0.12) / 1.12) ** exponent
        hx, hy, hz = lx + ex, ly + ey, lz + ez
        scale = 1.0 / np.sqrt(hx * hx + hy * hy + hz * hz)
        mx = nx - glint * (texel[3] * ux + texel[4] * vx)
        my = ny - glint * (texel[3] * uy + texel[4] * vy)
        mz = nz - glint * (texel[3] * uz + texel[4] * vz)
        scale /= np.sqrt(mx * mx + my * my + mz * mz)
        mirror = max(0.0, (mx * hx + my * hy + mz * hz) * scale)
        shine = glare * texel[5] * (mirror**shininess + sheen * mirror**8.0) * beam
        for channel in range(3):
            result[i, channel] = texel[channel] * (beam * facing + ambient * reach[i, 1]) + shine


@compiled(inlined=True)
def _sample(texture: FloatImage, u_px: float, v_px: float, texel: Array) -> None:
    """Bilinear sample of a periodic texture."""
    size = texture.shape[0]
    column, row = int(np.floor(u_px)), int(np.floor(v_px))
    a, b = u_px - column, v_px - row
    x0, y0 = column % size, row % size
    x1, y1 = (x0 + 1) % size, (y0 + 1) % size
    for channel in range(texture.shape[2]):
        upper = (1.0 - a) * texture[y0, x0, channel] + a * texture[y0, x1, channel]
        lower = (1.0 - a) * texture[y1, x0, channel] + a * texture[y1, x1, channel]
        texel[channel] = (1.0 - b) * upper + b * lower
