"""Per-pixel shading of the synthetic figure: procedural skin, eyes, hair, cloth and room, two lights with soft shadows.

Colours are functions of the rest position (millimetres), so they stick to the surface whatever the mesh's density,
and are the same from every camera. All in linear light; plain scalar code, compiled.
"""

import math

import numpy as np

from nbavatar.data.synthetic.noise import helper, jit, noise, put, smooth_step, white

__all__ = ["ARM", "CLOTH", "EYE", "HAIR", "HAND", "SKIN", "hairline", "shade"]

SKIN, EYE, HAND, HAIR, CLOTH, ARM = range(6)
"""Materials of faces."""

_GOLDEN = 2.399963229728653


def _disk(count: int) -> np.ndarray:
    """Points spread evenly over the unit disk (a sunflower)."""
    i = np.arange(count)
    radius = np.sqrt((i + 0.5) / count)
    return np.stack([radius * np.cos(_GOLDEN * i), radius * np.sin(_GOLDEN * i)], 1)


_SEARCH, _FILTER = _disk(10), _disk(14)


@helper("UniTuple(f8, 2)(f8, f8, f8, f8, f8, f8)")
def _segment(px, py, ax, ay, bx, by):
    """Distance to a segment and the parameter along it."""
    dx, dy = bx - ax, by - ay
    t = min(max(((px - ax) * dx + (py - ay) * dy) / max(dx * dx + dy * dy, 1e-9), 0.0), 1.0)
    ex, ey = px - ax - t * dx, py - ay - t * dy
    return math.sqrt(ex * ex + ey * ey), t


@helper("f8(f8, f8, f8)")
def hairline(x, y, z):
    """How far above the hairline [mm], for the head's rest position."""
    if z > 0:
        line = 57.0 + 0.1 * z
    elif z > -28:
        line = 57.0 + z * 0.35
    elif z > -48:
        line = 47.0 + (z + 28) * 2.1
    elif z > -82:
        line = 5.0 + (z + 48) * 0.1
    elif z > -105:
        line = 1.6 + (z + 82) * 2.0
    else:
        line = -44.4 + (z + 105) * 0.1
    if abs(x) > 70 and y < 14 and z < -50:
        line = max(line, 20.0)
    return y - line


@jit
def _skin(x, y, z, tone, hair, lips, brow, seed, points, field, out):
    """Colour of the face at rest position (x, y, z) [mm]; returns gloss."""
    put(points, 0, x / 22 + seed, y / 22, z / 22)
    put(points, 1, x / 7 + seed, y / 7 + 9, z / 7)
    put(points, 2, x / 1.7, y / 1.7 + seed, z / 1.7)
    put(points, 3, x / 2.6 + 40, y / 2.6 + seed, z / 2.6)
    put(points, 4, x / 0.9, y / 6 + seed, 0.0)
    put(points, 5, x / 0.7 + 0.5 * y, y / 3.5, seed)
    put(points, 6, x / 3, y / 3, z / 3)
    noise(points, 7, field)
    broad, blotch, pore, freckle = field[0], field[1], field[2], field[3]
    red = 0.10 * math.exp(-((abs(x) - 42) ** 2 + (y + 42) ** 2) / (2 * 16.0**2)) + 0.12 * math.exp(
        -(x * x + (y + 36) ** 2) / (2 * 9.0**2)
    ) * smooth_step(20, 34, z)
    red += 0.16 * smooth_step(66, 76, abs(x)) + 0.05 * max(blotch, 0.0)
    light = 1 + 0.06 * broad + 0.05 * blotch + 0.06 * pore
    shade_eye = 0.16 * math.exp(-((abs(x) - 30) ** 2 / (2 * 13.0**2) + (y + 4) ** 2 / (2 * 8.0**2)))
    light *= 1 - shade_eye
    light *= 1 - 0.20 * smooth_step(0.45, 0.9, freckle) * smooth_step(-65, -10, -abs(y + 25) - abs(x) * 0.3)
    out[0] = tone[0] * light * (1 + red)
    out[1] = tone[1] * light * (1 - 0.9 * red)
    out[2] = tone[2] * light * (1 - 0.9 * red)
    gloss = 0.35 + 0.35 * math.exp(-(x * x) / (2 * 12.0**2)) * smooth_step(-60, -20, y)
    front = smooth_step(8, 16, z)
    # lips: inside the outline, which is given by its upper and lower height over |x|
    n = len(lips)
    ax = abs(x)
    if ax < lips[n - 1, 0] + 2 and front > 0:
        i = 0
        while i < n - 2 and ax > lips[i + 1, 0]:
            i += 1
        t = min(max((ax - lips[i, 0]) / (lips[i + 1, 0] - lips[i, 0]), 0.0), 1.0)
        top, bottom = lips[i, 1] + t * (lips[i + 1, 1] - lips[i, 1]), lips[i, 2] + t * (lips[i + 1, 2] - lips[i, 2])
        inside = min(top - y, y - bottom, lips[n - 1, 0] - ax + 1.0)
        m = smooth_step(-0.7, 0.9, inside) * front
        crease = 1 + 0.10 * field[4]
        out[0] = out[0] * (1 - m) + m * crease * (0.35 * tone[0] + 0.20)
        out[1] = out[1] * (1 - m) + m * crease * 0.42 * tone[1]
        out[2] = out[2] * (1 - m) + m * crease * 0.50 * tone[2]
        gloss += 0.5 * m
    # inside of the mouth: behind the lips' front, which recedes to the corners; and the whole bag
    if ax < 27 and y > -97 and y < -56:
        deep = (
            smooth_step(30, 26, z + 0.022 * x * x)
            * smooth_step(-84, -81.5, y)
            * smooth_step(-63, -66, y)
            * smooth_step(24, 21, ax)
        )
        deep = max(
            deep,
            smooth_step(13, 9, z)
            * smooth_step(27, 23, ax)
            * smooth_step(-97, -93, y)
            * smooth_step(-57, -60, y)
            * smooth_step(-95, -90, z),
        )
        gloss *= 1 - 0.7 * deep
        out[0] = out[0] * (1 - deep) + deep * 0.06
        out[1] = out[1] * (1 - deep) + deep * 0.014
        out[2] = out[2] * (1 - deep) + deep * 0.014
    # brows
    if y > 2 and y < 26 and z > -5:
        best, along = 1e9, 0.0
        for i in range(len(brow) - 1):
            d, t = _segment(ax, y, brow[i, 0], brow[i, 1], brow[i + 1, 0], brow[i + 1, 1])
            if d < best:
                best, along = d, (i + t) / (len(brow) - 1)
        strand = field[5]
        m = smooth_step(5.4 - 3.0 * along, 1.6 - 0.8 * along, best + 1.1 * strand) * 0.92
        for c in range(3):
            out[c] = out[c] * (1 - m) + m * hair[c] * 0.7
        gloss *= 1 - 0.7 * m
    # scalp
    m = smooth_step(-2.5, 2.0, hairline(x, y, z) + 2.2 * field[6])
    if m > 0:
        for c in range(3):
            out[c] = out[c] * (1 - m) + m * hair[c]
        gloss *= 1 - m
    # lashes and lid rims
    return gloss


@jit
def _eye(x, y, z, iris, points, field, out):
    """Colour of an eyeball at unit direction (x, y, z) from its centre; z looks ahead."""
    r = math.sqrt(x * x + y * y) if z > 0 else 1.0
    angle = math.atan2(y, x)
    put(points, 0, x * 9, y * 9, z * 5)
    put(points, 1, angle * 5.0, r * 9, 3.0)
    noise(points, 2, field)
    vein = max(field[0] - 0.25, 0.0) * smooth_step(0.42, 0.9, r)
    out[0], out[1], out[2] = 0.74, 0.70 - 0.35 * vein, 0.66 - 0.35 * vein
    m = smooth_step(0.405, 0.375, r)
    ray = 1 + 0.3 * field[1]
    rim = 1 - 0.6 * smooth_step(0.31, 0.39, r)
    for c in range(3):
        out[c] = out[c] * (1 - m) + m * iris[c] * ray * rim
    m = smooth_step(0.155, 0.135, r)
    for c in range(3):
        out[c] = out[c] * (1 - m) + m * 0.008


@jit
def _hand_skin(x, y, z, ny, tone, nails, knuckles, seed, points, field, out):
    """Colour of the hand at rest position [mm]; `ny` > 0 on its back; returns gloss."""
    put(points, 0, x / 15 + seed, y / 15, z / 15)
    put(points, 1, x / 1.5, y / 1.5, z / 1.5 + seed)
    put(points, 2, x / 40 + 3, 0.0, z / 9 + seed)
    put(points, 3, x / 0.9, z / 7, y / 7)
    noise(points, 4, field)
    broad, pore = field[0], field[1]
    vein = math.exp(-(field[2] ** 2) / 0.02) * smooth_step(0.3, 0.8, ny) * smooth_step(-10, 30, x)
    palm = smooth_step(0.2, -0.5, ny)
    light = 1 + 0.05 * broad + 0.06 * pore + 0.10 * palm - 0.10 * vein
    red = 0.06 * palm
    crease = 0.0
    for i in range(len(knuckles)):
        dx, dz = x - knuckles[i, 0], z - knuckles[i, 2]
        d2 = dx * dx + dz * dz + (y - knuckles[i, 1]) ** 2
        if d2 < 300:
            red += 0.12 * math.exp(-d2 / 90)
            crease = max(crease, math.exp(-d2 / 60) * max(field[3], 0.0))
    light *= 1 - 0.3 * crease
    out[0], out[1], out[2] = (
        tone[0] * light * (1 + red),
        tone[1] * light * (1 - 0.8 * red),
        tone[2] * light * (1 - 0.8 * red),
    )
    gloss = 0.3
    for i in range(len(nails)):
        dx, dy, dz = x - nails[i, 0], y - nails[i, 1], z - nails[i, 2]
        a = dx * nails[i, 3] + dy * nails[i, 4] + dz * nails[i, 5]
        h = dx * nails[i, 6] + dy * nails[i, 7] + dz * nails[i, 8]
        s2 = max(dx * dx + dy * dy + dz * dz - a * a - h * h, 0.0)
        m = (
            smooth_step(1.15, 0.9, (a / 6.0) ** 2 + s2 / 4.8**2)
            * smooth_step(-2.5, -0.5, h)
            * smooth_step(0.1, 0.4, ny)
        )
        if m > 0:
            tip = smooth_step(3.6, 4.6, a)
            out[0] = out[0] * (1 - m) + m * (0.66 + 0.12 * tip) * (0.5 + 0.55 * tone[0])
            out[1] = out[1] * (1 - m) + m * (0.42 + 0.28 * tip) * (0.5 + 0.55 * tone[1])
            out[2] = out[2] * (1 - m) + m * (0.38 + 0.28 * tip) * (0.5 + 0.55 * tone[2])
            gloss += 1.2 * m
    return gloss


@jit
def _lit(px, py, pz, nx, ny, nz, light, k, from_world, depth, cosine, sine):
    """Share of a light that reaches a point: blocker search, then a filter as wide as the penumbra."""
    qx, qy, qz = px + nx * 0.0022, py + ny * 0.0022, pz + nz * 0.0022
    x = from_world[0, 0] * qx + from_world[0, 1] * qy + from_world[0, 2] * qz + from_world[0, 3]
    y = from_world[1, 0] * qx + from_world[1, 1] * qy + from_world[1, 2] * qz + from_world[1, 3]
    z = from_world[2, 0] * qx + from_world[2, 1] * qy + from_world[2, 2] * qz + from_world[2, 3]
    u, v = k[0] * x / z + k[2], k[1] * y / z + k[3]
    size = depth.shape[0]
    search = light[3] * 0.035 / z * k[0]
    blocked, where = 0, 0.0
    for i in range(len(_SEARCH)):
        a, b = _SEARCH[i, 0] * search, _SEARCH[i, 1] * search
        iu, iv = int(u + a * cosine - b * sine), int(v + a * sine + b * cosine)
        if iu >= 0 and iv >= 0 and iu < size and iv < size and depth[iv, iu] < z - 0.002:
            blocked += 1
            where += depth[iv, iu]
    if blocked == 0:
        return 1.0
    where /= blocked
    radius = max(light[3] * (z - where) / where / z * k[0], 1.0)
    lit = 0
    for i in range(len(_FILTER)):
        a, b = _FILTER[i, 0] * radius, _FILTER[i, 1] * radius
        iu, iv = int(u + a * cosine - b * sine), int(v + a * sine + b * cosine)
        if iu < 0 or iv < 0 or iu >= size or iv >= size or depth[iv, iu] >= z - 0.002 - 0.0004 * radius:
            lit += 1
    return lit / len(_FILTER)


@jit
def shade(
    face_id, bary, faces, verts, normals, rest, dorsal, occlusion, material, eye, up, lights, light_k,
    light_from_world, light_depth, colours, lips, brow, eyes, nails, knuckles, seed, image,
):  # fmt: skip
    """Colours of the pixels that see the figure, written into `image` (H, W, 3) float32, linear light.

    `face_id`, `bary` come from the z-buffer; `verts`, `normals` (V, 3) world; `rest` (V, 3) [mm]; `dorsal` (V,) up-
    component of the rest normal (1 on the back of the hand); `occlusion` (V,) share of ambient
    light; `material` (F,); `eye` (3,) the camera's place and `up` (3,), world; `lights` (L, 7): position, radius [m],
    colour; `colours` (6, 3): skin, hair, iris, shirt, ambient above and below.
    """
    height, width = face_id.shape
    colour, points, field = np.zeros(3), np.zeros((8, 3)), np.zeros(8)
    for py in range(height):
        for px in range(width):
            f = face_id[py, px]
            if f < 0:
                continue
            a, b, c_ = faces[f, 0], faces[f, 1], faces[f, 2]
            w0, w1, w2 = bary[py, px, 0], bary[py, px, 1], bary[py, px, 2]
            x = w0 * verts[a, 0] + w1 * verts[b, 0] + w2 * verts[c_, 0]
            y = w0 * verts[a, 1] + w1 * verts[b, 1] + w2 * verts[c_, 1]
            z = w0 * verts[a, 2] + w1 * verts[b, 2] + w2 * verts[c_, 2]
            nx = w0 * normals[a, 0] + w1 * normals[b, 0] + w2 * normals[c_, 0]
            ny = w0 * normals[a, 1] + w1 * normals[b, 1] + w2 * normals[c_, 1]
            nz = w0 * normals[a, 2] + w1 * normals[b, 2] + w2 * normals[c_, 2]
            size = max(math.sqrt(nx * nx + ny * ny + nz * nz), 1e-9)
            nx, ny, nz = nx / size, ny / size, nz / size
            rx = w0 * rest[a, 0] + w1 * rest[b, 0] + w2 * rest[c_, 0]
            ry = w0 * rest[a, 1] + w1 * rest[b, 1] + w2 * rest[c_, 1]
            rz = w0 * rest[a, 2] + w1 * rest[b, 2] + w2 * rest[c_, 2]
            ambient = w0 * occlusion[a] + w1 * occlusion[b] + w2 * occlusion[c_]
            vx, vy, vz = eye[0] - x, eye[1] - y, eye[2] - z
            size = math.sqrt(vx * vx + vy * vy + vz * vz)
            vx, vy, vz = vx / size, vy / size, vz / size
            facing = nx * vx + ny * vy + nz * vz
            if facing < 0:
                # seen from behind (inside of the neck, sleeves): shade the other side
                nx, ny, nz, facing = -nx, -ny, -nz, -facing
            kind = material[f]
            gloss, power, wrap = 0.3, 18.0, 0.25
            if kind == SKIN:
                gloss = _skin(rx, ry, rz, colours[0], colours[1], lips, brow, seed, points, field, colour)
            elif kind == EYE:
                side = 0 if rx > 0 else 1
                ex, ey, ez = rx - eyes[side, 0], ry - eyes[side, 1], rz - eyes[side, 2]
                size = max(math.sqrt(ex * ex + ey * ey + ez * ez), 1e-9)
                _eye(ex / size, ey / size, ez / size, colours[2], points, field, colour)
                gloss, power, wrap = 6.0, 300.0, 0.1
                ambient *= 0.75
            elif kind == HAND:
                back = w0 * dorsal[a] + w1 * dorsal[b] + w2 * dorsal[c_]
                gloss = _hand_skin(rx, ry, rz, back, colours[0], nails, knuckles, seed, points, field, colour)
            else:
                # hair, cloth and the arm's skin: a base colour and two noises, fine and coarse
                if kind == HAIR:
                    put(points, 0, rx / 1.1 + 0.12 * ry, ry / 14, rz / 1.1 + 0.12 * ry)
                    put(points, 1, rx / 4, ry / 20, rz / 4)
                elif kind == CLOTH:
                    put(points, 0, rx / 1.6, ry / 1.6, rz / 1.6)
                    put(points, 1, rx / 30, ry / 12, rz / 30)
                else:
                    put(points, 0, rx / 1.7, ry / 1.7, rz / 1.7)
                    put(points, 1, rx / 18, ry / 18, rz / 18)
                noise(points, 2, field)
                if kind == HAIR:
                    strand = field[0] + 0.5 * field[1]
                    base, factor = 1, max(1 + 0.55 * strand, 0.1)
                    gloss, power, wrap = 0.5 + 0.4 * strand, 24.0, 0.1
                elif kind == CLOTH:
                    base, factor = 3, 1 + 0.10 * field[0] + 0.12 * field[1]
                    gloss, power, wrap = 0.02, 6.0, 0.15
                else:
                    base, factor = 0, 1 + 0.05 * field[0] + 0.05 * field[1]
                for c in range(3):
                    colour[c] = colours[base, c] * factor
            sky = 0.5 + 0.5 * (nx * up[0] + ny * up[1] + nz * up[2])
            lr = ambient * (sky * colours[4, 0] + (1 - sky) * colours[5, 0])
            lg = ambient * (sky * colours[4, 1] + (1 - sky) * colours[5, 1])
            lb = ambient * (sky * colours[4, 2] + (1 - sky) * colours[5, 2])
            sr = sg = sb = 0.0
            spin = 6.2831853 * white(px, py, 1)
            spin_c, spin_s = math.cos(spin), math.sin(spin)
            for i in range(len(lights)):
                lx, ly, lz = lights[i, 0] - x, lights[i, 1] - y, lights[i, 2] - z
                size = math.sqrt(lx * lx + ly * ly + lz * lz)
                lx, ly, lz = lx / size, ly / size, lz / size
                cosine = nx * lx + ny * ly + nz * lz
                diffuse = max((cosine + wrap) / (1 + wrap), 0.0)
                if diffuse <= 0:
                    continue
                lit = 1.0
                if cosine > -0.15:
                    lit = _lit(
                        x, y, z, nx, ny, nz, lights[i], light_k[i], light_from_world[i], light_depth[i], spin_c, spin_s
                    )
                elif cosine <= -0.15:
                    lit = 0.6
                # the edge of a shadow on skin is warm: red light scatters furthest
                soft = 0.35 * lit * (1 - lit) if kind == SKIN or kind == HAND or kind == ARM else 0.0
                lr += diffuse * lights[i, 4] * min(lit + soft, 1.0)
                lg += diffuse * lights[i, 5] * lit
                lb += diffuse * lights[i, 6] * lit
                hx, hy, hz = lx + vx, ly + vy, lz + vz
                size = max(math.sqrt(hx * hx + hy * hy + hz * hz), 1e-9)
                h = max((nx * hx + ny * hy + nz * hz) / size, 0.0)
                fresnel = 0.04 + 0.5 * (1 - max(facing, 0.0)) ** 5
                s = gloss * fresnel * (power + 2) / 8 * h**power * lit * max(cosine, 0.0)
                sr += s * lights[i, 4]
                sg += s * lights[i, 5]
                sb += s * lights[i, 6]
            image[py, px, 0] = colour[0] * lr + sr
            image[py, px, 1] = colour[1] * lg + sg
            image[py, px, 2] = colour[2] * lb + sb
