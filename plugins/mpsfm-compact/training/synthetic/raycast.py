"""Compiled ray casting of boxes, ellipsoids and cylinders.

Every solid is a unit solid (cube [-1, 1]^3, unit ball, or cylinder of radius 1 along z in [-1, 1])
under an affine map. One intersection routine per kind of solid (cube, ball or cylinder) suffices.
In world coordinates, x and y are horizontal and z is up, in meters. In camera coordinates, x is
right, y down and z forward.
"""

from __future__ import annotations

import numpy as np
from numba import njit

BOX, BALL, CYLINDER = 0, 1, 2
PLAIN, MIRROR, WINDOW = 0, 1, 2
"""Appearance of a surface: its own color, a mirror reflection, or the sky seen through a window."""
GROUP = 8
"""Number of consecutive solids that share one bounding sphere for shadow rays."""
_NEAR = 1e-4
_TILE = 16
_compiled = njit(cache=True, fastmath={"contract", "reassoc", "nsz", "arcp"}, error_model="numpy")
"""Options of the numba compiler. The fast-math options keep comparisons with infinity exact."""


@_compiled
def _hit(kind, inverse, origin, direction):
    """Compute the distance along a ray to a unit solid (inf for a miss), and the face axis."""
    ox = inverse[0, 0] * origin[0] + inverse[0, 1] * origin[1] + inverse[0, 2] * origin[2]
    oy = inverse[1, 0] * origin[0] + inverse[1, 1] * origin[1] + inverse[1, 2] * origin[2]
    oz = inverse[2, 0] * origin[0] + inverse[2, 1] * origin[1] + inverse[2, 2] * origin[2]
    ox, oy, oz = ox + inverse[0, 3], oy + inverse[1, 3], oz + inverse[2, 3]
    dx = inverse[0, 0] * direction[0] + inverse[0, 1] * direction[1] + inverse[0, 2] * direction[2]
    dy = inverse[1, 0] * direction[0] + inverse[1, 1] * direction[1] + inverse[1, 2] * direction[2]
    dz = inverse[2, 0] * direction[0] + inverse[2, 1] * direction[1] + inverse[2, 2] * direction[2]
    if kind == BOX:
        enter, leave, axis = -np.inf, np.inf, 0
        for a in range(3):
            o = ox if a == 0 else (oy if a == 1 else oz)
            d = dx if a == 0 else (dy if a == 1 else dz)
            if abs(d) < 1e-12:
                if abs(o) > 1:
                    return np.inf, 0
                continue
            near, far = (-1 - o) / d, (1 - o) / d
            if near > far:
                near, far = far, near
            if near > enter:
                enter, axis = near, a
            leave = min(leave, far)
        if enter > leave or enter < _NEAR:  # faces are not visible from inside of a solid
            return np.inf, 0
        return enter, axis
    if kind == BALL:
        a = dx * dx + dy * dy + dz * dz
        b = ox * dx + oy * dy + oz * dz
        c = ox * ox + oy * oy + oz * oz - 1
        root = b * b - a * c
        if root < 0:
            return np.inf, 0
        t = (-b - np.sqrt(root)) / a
        return (t, 3) if t > _NEAR else (np.inf, 0)
    a = dx * dx + dy * dy
    b = ox * dx + oy * dy
    c = ox * ox + oy * oy - 1
    best, axis = np.inf, 0
    root = b * b - a * c
    if root >= 0 and a > 1e-12:
        t = (-b - np.sqrt(root)) / a
        if t > _NEAR and abs(oz + t * dz) <= 1:
            best, axis = t, 3
    if abs(dz) > 1e-12:
        t = (-np.sign(dz) - oz) / dz
        x, y = ox + t * dx, oy + t * dy
        if _NEAR < t < best and x * x + y * y <= 1:
            best, axis = t, 2
    return best, axis


@_compiled
def _first(solids, chosen, count, origin, direction):
    """Find distance, index (-1 for a miss) and face axis of the first hit among chosen solids."""
    kinds, inverses, centers, radii = solids
    best, solid, face = np.inf, -1, 0
    for k in range(count):
        i = chosen[k]
        if not _near(centers[i], radii[i], origin, direction, best):
            continue
        t, axis = _hit(kinds[i], inverses[i], origin, direction)
        if t < best:
            best, solid, face = t, i, axis
    return best, solid, face


@_compiled
def _blocked(solids, shadows, origin, direction, reach):
    """Return True if a shadow caster blocks the ray within the distance ``reach``."""
    kinds, inverses, centers, radii = solids
    opaque, group_centers, group_radii = shadows
    for g in range(len(group_radii)):
        if not _near(group_centers[g], group_radii[g], origin, direction, reach):
            continue
        for k in range(g * GROUP, min((g + 1) * GROUP, len(opaque))):
            i = opaque[k]
            if not _near(centers[i], radii[i], origin, direction, reach):
                continue
            t, _ = _hit(kinds[i], inverses[i], origin, direction)
            if t < reach:
                return True
    return False


@_compiled
def _near(center, radius, origin, direction, reach):
    """Return True if a ray meets a sphere within the distance ``reach``."""
    x, y, z = center[0] - origin[0], center[1] - origin[1], center[2] - origin[2]
    along = x * direction[0] + y * direction[1] + z * direction[2]
    if along + radius < 0 or along - radius > reach:
        return False
    return x * x + y * y + z * z - along * along <= radius * radius


@_compiled
def _surface(kinds, inverses, sizes, i, axis, point, direction, normal, uv):
    """Compute the normal and the texture coordinates (meters) of a surface point."""
    local = np.empty(3)
    for a in range(3):
        m = inverses[i, a]
        local[a] = m[0] * point[0] + m[1] * point[1] + m[2] * point[2] + m[3]
    n = np.zeros(3)
    if axis == 3:
        n[:] = local
        if kinds[i] == CYLINDER:
            n[2] = 0.0
    else:
        n[axis] = 1.0 if local[axis] > 0 else -1.0
    size = sizes[i]
    if kinds[i] == BALL:
        uv[0] = np.arctan2(local[1], local[0]) * size[0]
        uv[1] = np.arcsin(min(1.0, max(-1.0, local[2]))) * size[2]
    elif axis == 3:
        uv[0] = np.arctan2(local[1], local[0]) * size[0]
        uv[1] = local[2] * size[2]
    elif axis == 0:
        uv[0], uv[1] = local[1] * size[1], local[2] * size[2]
    elif axis == 1:
        uv[0], uv[1] = local[0] * size[0], local[2] * size[2]
    else:
        uv[0], uv[1] = local[0] * size[0], local[1] * size[1]
    length = 0.0
    for a in range(3):
        v = inverses[i, 0, a] * n[0] + inverses[i, 1, a] * n[1] + inverses[i, 2, a] * n[2]
        normal[a] = v
        length += v * v
    length = np.sqrt(length)
    towards = normal[0] * direction[0] + normal[1] * direction[1] + normal[2] * direction[2]
    sign = -1.0 if towards > 0 else 1.0
    for a in range(3):
        normal[a] *= sign / length


@_compiled
def _texture(textures, number, u, v, footprint, colour):
    """Interpolate a repeating texture at the mipmap level of the pixel footprint (in texels)."""
    size = textures.shape[2]
    level = 0
    while footprint > 1.5 and level < textures.shape[0] - 1:
        footprint *= 0.5
        level += 1
    x, y = u * size - 0.5, v * size - 0.5
    x0, y0 = int(np.floor(x)), int(np.floor(y))
    fx, fy = x - x0, y - y0
    for c in range(3):
        a = textures[level, number, y0 % size, x0 % size, c] * (1 - fx)
        a += textures[level, number, y0 % size, (x0 + 1) % size, c] * fx
        b = textures[level, number, (y0 + 1) % size, x0 % size, c] * (1 - fx)
        b += textures[level, number, (y0 + 1) % size, (x0 + 1) % size, c] * fx
        colour[c] = (a * (1 - fy) + b * fy) / 255.0


@_compiled
def _sky(direction, sky, colour):
    """Compute the sky color in a direction from a horizon-to-zenith gradient and a sun."""
    up = max(0.0, direction[2]) ** 0.5
    glow = direction[0] * sky[2, 0] + direction[1] * sky[2, 1] + direction[2] * sky[2, 2]
    glow = max(0.0, glow) ** 40 * 0.6
    for c in range(3):
        colour[c] = sky[0, c] * (1 - up) + sky[1, c] * up + glow


@_compiled
def _shade(scene, i, axis, point, direction, distance, pixel, normal, colour):
    """Compute the light that a surface point sends along a ray: texture, lights and shadows."""
    solids, sizes, looks, textures, shadows, lights, ambient = scene
    kinds, inverses, _, _ = solids
    uv = np.empty(2)
    _surface(kinds, inverses, sizes, i, axis, point, direction, normal, uv)
    look = looks[i]  # appearance: texture index, 1 / period, tint rgb, offset uv, shine, glow
    slant = max(
        0.15, -(normal[0] * direction[0] + normal[1] * direction[1] + normal[2] * direction[2])
    )
    texels = distance * pixel * look[1] * textures.shape[2] / slant
    _texture(
        textures, int(look[0]), uv[0] * look[1] + look[5], uv[1] * look[1] + look[6], texels, colour
    )
    for c in range(3):
        colour[c] *= look[2 + c]
    total = np.empty(3)
    level = 0.5 + 0.5 * normal[2]
    for c in range(3):
        total[c] = ambient[0, c] * level + ambient[1, c] * (1 - level) + look[8]
    shine = 0.0
    start = np.empty(3)
    for a in range(3):
        start[a] = point[a] + 2e-3 * normal[a]
    towards = np.empty(3)
    for k in range(len(lights)):
        light = lights[k]  # position or direction of a light, color rgb, and 1 for a sun
        reach = 0.0
        for a in range(3):
            towards[a] = light[a] - (0.0 if light[6] > 0 else start[a])
            reach += towards[a] * towards[a]
        reach = np.sqrt(reach)
        for a in range(3):
            towards[a] /= reach
        cosine = towards[0] * normal[0] + towards[1] * normal[1] + towards[2] * normal[2]
        if cosine <= 0:
            continue
        if _blocked(solids, shadows, start, towards, 1e9 if light[6] > 0 else reach):
            continue
        strength = cosine if light[6] > 0 else cosine / (0.3 + reach * reach)
        half = 0.0
        for a in range(3):
            half += (2 * cosine * normal[a] - towards[a]) * -direction[a]
        shine += look[7] * strength * max(0.0, half) ** 20
        for c in range(3):
            total[c] += strength * light[3 + c]
    for c in range(3):
        colour[c] = colour[c] * total[c] + shine


@_compiled
def draw(scene, shows, sky, origin, rotation, focal, width, height, image, depth, normals, kind):
    """Render color, depth, normals and surface kind of a scene.

    ``scene`` starts with the kinds (n,), inverse affine maps (n, 3, 4), centers (n, 3) and radii
    (n,) of the solids. The next elements of ``scene`` are half sizes (n, 3), surface appearances
    (n, 9), and textures (levels, t, s, s, 3). The shadow casters in ``scene`` are solid indices,
    and bounding spheres of :data:`GROUP` solids each. The last elements of ``scene`` are lights (m,
    7) and the ambient light (2, 3) from above and below. ``shows`` (n,) is PLAIN, MIRROR or WINDOW
    for each solid, and ``rotation`` is world_from_camera.

    The function fills ``image`` (h, w, 3) in linear light, ``depth`` (h, w) along z, ``normals``
    (h, w, 3) in the camera frame, and ``kind`` (h, w) uint8. In ``kind``, 0 is sky, 1 is a surface,
    and 2 is a mirror or window.
    """
    solids = scene[0]
    centers, radii = solids[2], solids[3]
    n = len(radii)
    everything = np.arange(n)
    chosen = np.empty(n, np.int64)
    direction, ray, point = np.empty(3), np.empty(3), np.empty(3)
    normal, colour, other = np.empty(3), np.empty(3), np.empty(3)
    for top in range(0, height, _TILE):
        for left in range(0, width, _TILE):
            bottom, right = min(top + _TILE, height), min(left + _TILE, width)
            cx, cy = (left + right) / 2 - width / 2, (top + bottom) / 2 - height / 2
            length = np.sqrt(cx * cx + cy * cy + focal * focal)
            spread = (
                0.75 * _TILE / length
            )  # maximum angle in rad between the axis of an image tile and its corner rays
            for a in range(3):
                ray[a] = (
                    rotation[a, 0] * cx + rotation[a, 1] * cy + rotation[a, 2] * focal
                ) / length
            count = 0
            for i in range(n):
                x, y, z = (
                    centers[i, 0] - origin[0],
                    centers[i, 1] - origin[1],
                    centers[i, 2] - origin[2],
                )
                along = x * ray[0] + y * ray[1] + z * ray[2]
                far = np.sqrt(x * x + y * y + z * z)
                if far > radii[i]:
                    size = np.arcsin(radii[i] / far) + spread
                    if size < 1.5 and along < far * np.cos(size):
                        continue
                chosen[count] = i
                count += 1
            for row in range(top, bottom):
                for column in range(left, right):
                    px, py = column + 0.5 - width / 2, row + 0.5 - height / 2
                    length = np.sqrt(px * px + py * py + focal * focal)
                    for a in range(3):
                        direction[a] = rotation[a, 0] * px + rotation[a, 1] * py
                        direction[a] = (direction[a] + rotation[a, 2] * focal) / length
                    t, i, axis = _first(solids, chosen, count, origin, direction)
                    if i < 0:
                        _sky(direction, sky, colour)
                        image[row, column] = colour
                        depth[row, column] = 0.0
                        normals[row, column] = 0.0
                        kind[row, column] = 0
                        continue
                    for a in range(3):
                        point[a] = origin[a] + t * direction[a]
                    _shade(scene, i, axis, point, direction, t, 1 / length, normal, colour)
                    depth[row, column] = t * focal / length
                    for a in range(3):
                        normals[row, column, a] = (
                            rotation[0, a] * normal[0]
                            + rotation[1, a] * normal[1]
                            + rotation[2, a] * normal[2]
                        )
                    kind[row, column] = 1
                    if shows[i] == WINDOW:
                        _sky(direction, sky, colour)
                        kind[row, column] = 2
                    elif shows[i] == MIRROR:
                        along = normal[0] * direction[0] + normal[1] * direction[1]
                        along += normal[2] * direction[2]
                        for a in range(3):
                            direction[a] -= 2 * along * normal[a]
                            point[a] += 1e-3 * normal[a]
                        t2, j, axis2 = _first(solids, everything, n, point, direction)
                        if j >= 0:
                            for a in range(3):
                                ray[a] = point[a] + t2 * direction[a]
                            _shade(
                                scene, j, axis2, ray, direction, t + t2, 1 / length, other, colour
                            )
                        else:
                            _sky(direction, sky, colour)
                        kind[row, column] = 2
                    image[row, column] = colour
