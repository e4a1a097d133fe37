"""Compliant position-based dynamics: one step of a soft surface against moving points.

XPBD (Macklin, Mueller and Chentanez 2016) on displacements from a rest shape. Every constraint C has an energy k/2
C^2; in a time step h its compliance is 1 / (k h^2), so that stiffness means the same at any step length and iteration
count, and 0 (off) and 1e12 (rigid) are ordinary values. Constraints are projected one after the other in a fixed
order: deterministic. There is no velocity: skin is overdamped, and a step starts from rest.
"""

import math

import numpy as np

from nbavatar.jit.cache import stored_njit

__all__ = ["relax"]


@stored_njit(error_model="numpy")
def relax(
    x, rest, inverse_mass, active, support, edges, lengths, stretch, shear, ring, ring_ids, ring_weights, bend,
    faces, bulge, volume_stiffness, contacts, ids, weights, hand, pose, pose_inverse_mass, pose_stiffness, pose_bound,
    centre, dt, iterations, friction, max_dent,
):  # fmt: skip
    """Moves `x` and `pose` in place towards the energy minimum, contacts last in every iteration.

    Args:
        x: positions [m], (V, 3) float64; what they are at entry is where inertia and friction hold them.
        rest: rest shape [m], (V, 3).
        inverse_mass: (V,) [1/kg], 0 = does not move.
        active: ids of vertices with support and bending, (A,) int64.
        support: stiffness of the bed under each vertex, (V,) [N/m].
        edges: (E, 2) int64; `lengths` (E,) [m] at rest; `stretch` stiffness of an edge [N/m];
            `shear` stiffness of the difference of the displacements of its ends [N/m].
        ring: (V + 1,) int64 starts, `ring_ids` and `ring_weights` [1/m^2]: rows of the Laplacian of displacements.
        bend: stiffness of the squared Laplacian, (V,) [N m^3].
        faces: (G, 3) faces whose volume counts; `bulge` (V,) in [0, 1] where the volume may come out;
            `volume_stiffness` [N/m^5].
        contacts: (C, 9) hand point now, hand point at the start of the step, unit normal from head to hand [m].
        ids: (C, 3) head vertices of the contact, `weights` (C, 3) their barycentric weights.
        hand: (C,) index of the hand.
        pose: (H, 6) correction of each hand: translation [m], rotation vector [rad] about `centre` (H, 3) [m].
        pose_inverse_mass: (H, 2) [1/kg], [1/(kg m^2)]; `pose_stiffness` (2,) [N/m], [N m]; `pose_bound` (2,) [m],
            [rad]. The hand points given hold for the pose at entry.
        dt: time step [s]. iterations: at least 1. friction: Coulomb coefficient. max_dent: limit of ``|x - rest|`` [m].

    Returns:
        Normal impulse of each contact, (C,) [kg m]: force times dt^2.
    """
    h2 = dt * dt
    start = x.copy()
    entry = pose.copy()
    support_l = np.zeros((len(active), 3))
    bend_l = np.zeros((len(active), 3))
    stretch_l = np.zeros(len(edges))
    shear_l = np.zeros((len(edges), 3))
    pose_l = np.zeros(pose.shape)
    volume_l = 0.0
    pressed = np.zeros(len(ids))
    sheared = np.zeros((len(ids), 3))
    gradient = np.zeros((len(x) if volume_stiffness > 0.0 else 0, 3))
    origin = rest[active[0]] if len(active) else rest[0]
    volume = _volume(rest, origin, faces, gradient) if volume_stiffness > 0.0 else 0.0
    stretch_a = 1.0 / (stretch * h2) if stretch > 0.0 else 0.0
    shear_a = 1.0 / (shear * h2) if shear > 0.0 else 0.0
    for _ in range(iterations):
        _support(x, rest, inverse_mass, active, support, h2, support_l)
        if stretch > 0.0:
            _stretch(x, inverse_mass, edges, lengths, stretch_a, stretch_l)
        if shear > 0.0:
            _shear(x, rest, inverse_mass, edges, shear_a, shear_l)
        _bend(x, rest, inverse_mass, active, ring, ring_ids, ring_weights, bend, h2, bend_l)
        # What is pressed in comes out beside, as far as the tissue resists compression.
        if volume_stiffness > 0.0:
            volume_l += _hold_volume(
                x, inverse_mass, active, faces, bulge, gradient, origin, volume, volume_l, volume_stiffness * h2
            )
        _hold_hands(pose, pose_inverse_mass, pose_stiffness, h2, pose_l)
        _bound(pose, pose_bound)
        _touch(
            x, start, inverse_mass, contacts, ids, weights, hand, pose, entry, pose_inverse_mass, centre, friction,
            pressed, sheared,
        )  # fmt: skip
        _bound(pose, pose_bound)
        _limit(x, rest, inverse_mass, active, max_dent)
    return pressed


@stored_njit(error_model="numpy")
def _support(x, rest, inverse_mass, active, support, h2, impulse):
    """Bed: every vertex to its rest place."""
    for s in range(len(active)):
        i = active[s]
        w = inverse_mass[i]
        if w > 0.0 and support[i] > 0.0:
            a = 1.0 / (support[i] * h2)
            for c in range(3):
                step = (rest[i, c] - x[i, c] - a * impulse[s, c]) / (w + a)
                impulse[s, c] += step
                x[i, c] += w * step


@stored_njit(error_model="numpy")
def _stretch(x, inverse_mass, edges, lengths, compliance, impulse):
    """Membrane: every edge to its rest length."""
    for e in range(len(edges)):
        i, j = edges[e, 0], edges[e, 1]
        w = inverse_mass[i] + inverse_mass[j]
        d0, d1, d2 = x[i, 0] - x[j, 0], x[i, 1] - x[j, 1], x[i, 2] - x[j, 2]
        length = math.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
        if w > 0.0 and length > 1e-12:
            step = (lengths[e] - length - compliance * impulse[e]) / (w + compliance)
            impulse[e] += step
            step /= length
            wi, wj = inverse_mass[i] * step, inverse_mass[j] * step
            x[i, 0] += wi * d0
            x[i, 1] += wi * d1
            x[i, 2] += wi * d2
            x[j, 0] -= wj * d0
            x[j, 1] -= wj * d1
            x[j, 2] -= wj * d2


@stored_njit(error_model="numpy")
def _shear(x, rest, inverse_mass, edges, compliance, impulse):
    """Shear layer: neighbours are displaced alike."""
    for e in range(len(edges)):
        i, j = edges[e, 0], edges[e, 1]
        wi, wj = inverse_mass[i], inverse_mass[j]
        if wi + wj > 0.0:
            for c in range(3):
                gap = (x[i, c] - rest[i, c]) - (x[j, c] - rest[j, c])
                step = (-gap - compliance * impulse[e, c]) / (wi + wj + compliance)
                impulse[e, c] += step
                x[i, c] += wi * step
                x[j, c] -= wj * step


@stored_njit(error_model="numpy")
def _bend(x, rest, inverse_mass, active, ring, ring_ids, ring_weights, bend, h2, impulse):
    """Plate: the displacement's Laplacian to zero."""
    for s in range(len(active)):
        i = active[s]
        if bend[i] <= 0.0:
            continue
        a = 1.0 / (bend[i] * h2)
        total, w = 0.0, 0.0
        c0, c1, c2 = 0.0, 0.0, 0.0
        u0, u1, u2 = x[i, 0] - rest[i, 0], x[i, 1] - rest[i, 1], x[i, 2] - rest[i, 2]
        for t in range(ring[i], ring[i + 1]):
            j, r = ring_ids[t], ring_weights[t]
            c0 += r * (x[j, 0] - rest[j, 0] - u0)
            c1 += r * (x[j, 1] - rest[j, 1] - u1)
            c2 += r * (x[j, 2] - rest[j, 2] - u2)
            total += r
            w += r * r * inverse_mass[j]
        w += total * total * inverse_mass[i]
        if w <= 0.0:
            continue
        s0 = (-c0 - a * impulse[s, 0]) / (w + a)
        s1 = (-c1 - a * impulse[s, 1]) / (w + a)
        s2 = (-c2 - a * impulse[s, 2]) / (w + a)
        impulse[s, 0] += s0
        impulse[s, 1] += s1
        impulse[s, 2] += s2
        for t in range(ring[i], ring[i + 1]):
            j = ring_ids[t]
            f = ring_weights[t] * inverse_mass[j]
            x[j, 0] += f * s0
            x[j, 1] += f * s1
            x[j, 2] += f * s2
        f = total * inverse_mass[i]
        x[i, 0] -= f * s0
        x[i, 1] -= f * s1
        x[i, 2] -= f * s2


@stored_njit(error_model="numpy")
def _hold_hands(pose, pose_inverse_mass, pose_stiffness, h2, impulse):
    """Hands: towards their tracked pose."""
    for k in range(len(pose)):
        for part in range(2):
            w = pose_inverse_mass[k, part]
            if w > 0.0 and pose_stiffness[part] > 0.0:
                a = 1.0 / (pose_stiffness[part] * h2)
                for c in range(3 * part, 3 * part + 3):
                    step = (-pose[k, c] - a * impulse[k, c]) / (w + a)
                    impulse[k, c] += step
                    pose[k, c] += w * step


@stored_njit(error_model="numpy")
def _limit(x, rest, inverse_mass, active, max_dent):
    """No point goes farther than `max_dent` from its rest place."""
    for s in range(len(active)):
        i = active[s]
        u0, u1, u2 = x[i, 0] - rest[i, 0], x[i, 1] - rest[i, 1], x[i, 2] - rest[i, 2]
        square = u0 * u0 + u1 * u1 + u2 * u2
        if square > max_dent * max_dent and inverse_mass[i] > 0.0:
            shrink = max_dent / math.sqrt(square)
            x[i, 0] = rest[i, 0] + shrink * u0
            x[i, 1] = rest[i, 1] + shrink * u1
            x[i, 2] = rest[i, 2] + shrink * u2


@stored_njit(error_model="numpy")
def _bound(pose, bound):
    for k in range(len(pose)):
        for part in range(2):
            c = 3 * part
            size = math.sqrt(pose[k, c] ** 2 + pose[k, c + 1] ** 2 + pose[k, c + 2] ** 2)
            if size > bound[part]:
                shrink = bound[part] / size
                pose[k, c] *= shrink
                pose[k, c + 1] *= shrink
                pose[k, c + 2] *= shrink


@stored_njit(error_model="numpy")
def _volume(x, origin, faces, gradient):
    """Volume between faces and a point [m^3]; adds its derivative by each corner to `gradient`, of the closed region.

    The derivative takes a third of a face's area vector for each of its corners: what the faces beyond the border of
    the region would add to it is the same before and after, and left out.
    """
    total = 0.0
    for f in range(len(faces)):
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        a0, a1, a2 = x[i, 0] - origin[0], x[i, 1] - origin[1], x[i, 2] - origin[2]
        e0, e1, e2 = x[j, 0] - x[i, 0], x[j, 1] - x[i, 1], x[j, 2] - x[i, 2]
        g0, g1, g2 = x[k, 0] - x[i, 0], x[k, 1] - x[i, 1], x[k, 2] - x[i, 2]
        n0, n1, n2 = (e1 * g2 - e2 * g1) / 6.0, (e2 * g0 - e0 * g2) / 6.0, (e0 * g1 - e1 * g0) / 6.0
        total += a0 * n0 + a1 * n1 + a2 * n2
        for c in range(3):
            v = faces[f, c]
            gradient[v, 0] += n0
            gradient[v, 1] += n1
            gradient[v, 2] += n2
    return total


@stored_njit(error_model="numpy")
def _hold_volume(x, inverse_mass, active, faces, bulge, gradient, origin, volume, impulse, stiffness):
    """One projection of the volume constraint; returns the change of its impulse."""
    for s in range(len(active)):
        gradient[active[s]] = 0.0
    change = _volume(x, origin, faces, gradient) - volume
    w = 0.0
    for s in range(len(active)):
        i = active[s]
        g = gradient[i, 0] ** 2 + gradient[i, 1] ** 2 + gradient[i, 2] ** 2
        w += inverse_mass[i] * bulge[i] * g
    if w <= 0.0:
        return 0.0
    a = 1.0 / stiffness
    step = (-change - a * impulse) / (w + a)
    for s in range(len(active)):
        i = active[s]
        f = inverse_mass[i] * bulge[i] * step
        for c in range(3):
            x[i, c] += f * gradient[i, c]
    return step


@stored_njit(error_model="numpy")
def _touch(
    x, start, inverse_mass, contacts, ids, weights, hand, pose, entry, pose_inverse_mass, centre, friction, pressed,
    sheared,
):  # fmt: skip
    """Non-penetration n . (p - q) >= 0 and Coulomb friction for every contact."""
    d = np.zeros(3)
    for k in range(len(ids)):
        h = hand[k]
        n0, n1, n2 = contacts[k, 6], contacts[k, 7], contacts[k, 8]
        r0, r1, r2 = contacts[k, 0] - centre[h, 0], contacts[k, 1] - centre[h, 1], contacts[k, 2] - centre[h, 2]
        t0, t1, t2 = pose[h, 3] - entry[h, 3], pose[h, 4] - entry[h, 4], pose[h, 5] - entry[h, 5]
        p0 = contacts[k, 0] + pose[h, 0] - entry[h, 0] + t1 * r2 - t2 * r1
        p1 = contacts[k, 1] + pose[h, 1] - entry[h, 1] + t2 * r0 - t0 * r2
        p2 = contacts[k, 2] + pose[h, 2] - entry[h, 2] + t0 * r1 - t1 * r0
        w = 0.0
        q0, q1, q2, s0, s1, s2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for c in range(3):
            i, b = ids[k, c], weights[k, c]
            q0 += b * x[i, 0]
            q1 += b * x[i, 1]
            q2 += b * x[i, 2]
            s0 += b * start[i, 0]
            s1 += b * start[i, 1]
            s2 += b * start[i, 2]
            w += b * b * inverse_mass[i]
        m0, m1, m2 = r1 * n2 - r2 * n1, r2 * n0 - r0 * n2, r0 * n1 - r1 * n0
        wt, wr = pose_inverse_mass[h, 0], pose_inverse_mass[h, 1]
        total = w + wt + wr * (m0 * m0 + m1 * m1 + m2 * m2)
        if total <= 0.0:
            continue
        gap = n0 * (p0 - q0) + n1 * (p1 - q1) + n2 * (p2 - q2)
        step = max(pressed[k] - gap / total, 0.0) - pressed[k]
        pressed[k] += step
        d[0], d[1], d[2] = step * n0, step * n1, step * n2
        if friction > 0.0 and w > 0.0:
            # Slip of the hand over the skin since the step began, without its normal part.
            v0 = p0 - contacts[k, 3] - (q0 - s0)
            v1 = p1 - contacts[k, 4] - (q1 - s1)
            v2 = p2 - contacts[k, 5] - (q2 - s2)
            normal = v0 * n0 + v1 * n1 + v2 * n2
            f0 = sheared[k, 0] - (v0 - normal * n0) / w
            f1 = sheared[k, 1] - (v1 - normal * n1) / w
            f2 = sheared[k, 2] - (v2 - normal * n2) / w
            size = math.sqrt(f0 * f0 + f1 * f1 + f2 * f2)
            limit = friction * pressed[k]
            shrink = limit / size if size > limit else 1.0
            # The hand is pulled by nothing but the normal force: its track already contains what friction did to it.
            for c in range(3):
                f = (f0, f1, f2)[c] * shrink
                change = f - sheared[k, c]
                sheared[k, c] = f
                for v in range(3):
                    i = ids[k, v]
                    x[i, c] -= weights[k, v] * inverse_mass[i] * change
        for v in range(3):
            i = ids[k, v]
            f = weights[k, v] * inverse_mass[i]
            x[i, 0] -= f * d[0]
            x[i, 1] -= f * d[1]
            x[i, 2] -= f * d[2]
        pose[h, 0] += wt * d[0]
        pose[h, 1] += wt * d[1]
        pose[h, 2] += wt * d[2]
        pose[h, 3] += wr * step * m0
        pose[h, 4] += wr * step * m1
        pose[h, 5] += wr * step * m2
