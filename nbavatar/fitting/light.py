"""The light of the studio, from how the brightness of the same skin changes between frames.

A face of colour a (its albedo) that is turned, and shadowed, in N frames has the brightness

    I(n) = a S(n),    S(n) = sum_k w_k incidence_k(n)

with far lights of strength w_k >= 0 all around (`nbavatar.mesh.incidence`): one product of unknowns for each face, and
one set of w for all. In 1 / a the equations are linear: sum (I(n) / a - S(n))^2 is, with the best a of each face put
in, a quadratic form in w, and its smallest value among w >= 0 of a given sum is a convex problem with one solution. It
favours lights that change little; from there on a and w are found in turns by least squares of I - a S. What a camera
adds by its own place (gloss) counts as noise.

A lamp throws sharp shadows from one direction, and of 256 lights evenly spread over the sphere the nearest is 5 degrees
away in the mean, which moves the shadow of a finger by half its width. So the strongest lights get neighbours at half
their distance, all are fitted again, and once more at a quarter of it.

Faces whose brightness no light explains are left out of the fit: eyes that look around, skin that hair slides over.

Whether there is such a light is judged by frames that took no part: fitted to two of three frames, it has to explain
how bright the others are better than the mean brightness of each face does. Faces that hardly any light reaches in the
frames of the fit are not judged: their albedo cannot be told.

Brightness is that of linear light (sRGB's transfer function undone, IEC 61966-2-1), mean over red, green and blue:
coloured lights are taken for grey ones.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from nbavatar.data.lights import Light
from nbavatar.io.images import linear_light
from nbavatar.math.directions import axes_along

__all__ = ["Brightness", "add_picture", "estimate_light"]

_SEEN = 3  # frames in which a face must be seen to say something
_FRAMES = 6  # fewest frames to tell light from skin
_FACES = 50  # fewest faces
_MOST = 8.0  # pixels from which on a face's mean brightness counts no more
_DARK = 1e-3  # brightness below which nothing is said
_LIT = 0.05  # least light, in the mean of the frames of the fit, from which a face's albedo can be told
_RIDGE, _LOOSE = (
    1e-3,
    1e-4,
)  # pull towards equal lights all around, of the mean curvature: at first, and among those kept
_CONVEX, _TURNS = 3, 8  # rounds of the convex problem, and of a and w in turns
_ROBUST = 1.0  # misfit, in units of S, at which a reading has half its weight
_UNSTEADY = 3.0  # faces whose misfit is so many times the typical one do not show light
_HALVINGS = 2  # of the distance between lights, around the strongest
_STRONG = 4.0  # strength from which a light gets neighbours, in units of an equal share of all lights tried
_REFINED = 16  # most lights that get neighbours in a round
_CARRIED = 96  # most lights that a round hands on, unless more are to be kept
_LEFT = 1e-4  # share of all light below which a light is none
_SUM = 4.0


class Brightness(NamedTuple):
    """What the cameras saw of F faces in N frames; `add_picture` fills it.

    Attributes:
        light: sums over pixels of linear brightness, float64 (N, F).
        pixels: their number, float64 (N, F).
    """

    light: np.ndarray
    pixels: np.ndarray


def add_picture(
    seen: Brightness, row: int, rgb: np.ndarray, usable: np.ndarray, face: np.ndarray, chosen: np.ndarray
) -> None:
    """Adds one camera's picture of a frame.

    Args:
        seen: changed in place.
        row: of the frame.
        rgb: uint8 (h, w, 3), sRGB; usable: pixels that show a part's surface alone, bool (h, w).
        face: face in each pixel, -1 for none, (h, w).
        chosen: place of each face among the F that are looked at, -1 for those that are not, (all faces,).
    """
    place = np.where(face >= 0, chosen[face], -1)
    ok = usable & (place >= 0)
    count = seen.light.shape[1]
    seen.light[row] += np.bincount(place[ok], linear_light(rgb[ok]).mean(-1), minlength=count)
    seen.pixels[row] += np.bincount(place[ok], minlength=count)


def estimate_light(
    reach: Callable[[np.ndarray], np.ndarray], seen: Brightness, directions: np.ndarray, *, kept: int, least: float
) -> tuple[Light, dict[str, Any]]:
    """Far lights that explain how the brightness of faces changes.

    Args:
        reach: incidence float32 (N, K, F) of lights in directions (K, 3); of a part that is not in a frame, anything.
        seen: brightness of the faces.
        directions: that are tried first, evenly spread over the sphere, unit, world (K, 3).
        kept: most lights that are kept, the strongest.
        least: share of the change, in frames that took no part, that has to be explained for a light to be kept.

    Returns:
        the light, and what was found, for records: `explained`, `lights`, or `absent` with the reason.
    """
    readings = np.where(seen.pixels > 0, seen.light / np.maximum(seen.pixels, 1.0), 0.0)
    weight = np.minimum(seen.pixels, _MOST)
    nothing = Light(np.zeros((0, 3), np.float32), np.zeros(0, np.float32))
    held = np.arange(len(readings)) % 3 == 1
    incident = reach(directions)
    fold = _Readings.of(incident, readings, weight, ~held)
    said: dict[str, Any] = {"frames": len(readings), "faces": fold.count}
    if len(readings) < _FRAMES or fold.count < _FACES:
        reason = f"{fold.count} faces are seen in {_SEEN} of {len(readings)} frames"
        return nothing, {
            **said,
            "absent": f"{reason}; at least {_FACES} faces and {_FRAMES} frames tell light from skin",
        }
    first = _strengths(fold, np.arange(len(directions)), _RIDGE)
    told = weight * _steady(incident, readings, weight, ~held, first)
    tried, incident = _refined(reach, directions, incident, readings, told, ~held, max(_CARRIED, kept))
    chosen, found = _strongest(_Readings.of(incident, readings, told, ~held), kept)
    explained = _explained(incident[:, chosen], readings, weight, held, found)
    said["explained"] = round(explained, 4)
    if explained < least:
        return nothing, {
            **said,
            "absent": f"a light that stands still explains {100 * explained:.0f} % of how skin changes",
        }
    chosen, found = _strongest(_Readings.of(incident, readings, told, np.ones(len(readings), bool)), kept)
    lit = found > _LEFT * _SUM
    found = found[lit] * (_SUM / found[lit].sum())
    said["lights"] = int(lit.sum())
    return Light(tried[chosen][lit].astype(np.float32), found.astype(np.float32)), said


def _steady(
    incident: np.ndarray, light: np.ndarray, weight: np.ndarray, rows: np.ndarray, strengths: np.ndarray
) -> np.ndarray:
    """Which faces look, in the frames `rows`, as if light alone changed them, bool (F,)."""
    shine, light, weight = _shine(incident[rows], strengths), light[rows], weight[rows]
    misfit = light / np.maximum(_albedo(light, weight, shine), 1e-4) - shine
    size = np.sqrt((weight * misfit**2).sum(0) / np.maximum(weight.sum(0), 1e-12))
    return np.asarray(size <= _UNSTEADY * np.median(size[_telling(light, weight)]))


def _refined(
    reach: Callable[[np.ndarray], np.ndarray],
    directions: np.ndarray,
    incident: np.ndarray,
    light: np.ndarray,
    weight: np.ndarray,
    rows: np.ndarray,
    most: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Lights that stand closer where it is bright, (K', 3), and their incidence (N, K', F); a round hands on `most`."""
    strong = _STRONG * _SUM / len(directions)
    apart = np.sqrt(4.0 * np.pi / len(directions))
    ridge = _RIDGE
    for halving in range(1, _HALVINGS + 1):
        found = _strengths(_Readings.of(incident, light, weight, rows), np.arange(len(directions)), ridge)
        order = np.argsort(-found, kind="stable")
        carried = order[:most][found[order[:most]] > _LEFT * _SUM]
        bright = order[:_REFINED][found[order[:_REFINED]] > strong]
        new = _neighbours(directions[bright], directions[carried], apart / 2**halving)
        directions = np.concatenate([directions[carried], new])
        incident = np.concatenate([incident[:, carried], reach(new)], axis=1) if len(new) else incident[:, carried]
        ridge = _LOOSE
    return directions, incident


def _neighbours(bright: np.ndarray, known: np.ndarray, angle: float) -> np.ndarray:
    """Six directions around each of `bright` (B, 3), `angle` [radians] from it; none closer than half of that to one of
    `known` (K, 3) or to another.
    """
    turns = np.arange(6) * (np.pi / 3.0)
    found: list[np.ndarray] = []
    for right, up, axis in axes_along(bright):
        ring = np.cos(turns)[:, None] * right + np.sin(turns)[:, None] * up
        for direction in np.cos(angle) * axis + np.sin(angle) * ring:
            if (np.concatenate([known, *(one[None] for one in found)]) @ direction).max() < np.cos(0.5 * angle):
                found.append(direction)
    return np.stack(found) if found else np.zeros((0, 3))


def _strongest(readings: "_Readings", count: int) -> tuple[np.ndarray, np.ndarray]:
    """The strongest lights, (count,), and their strengths without the others."""
    every = np.arange(readings.incident.shape[1])
    chosen = np.sort(np.argsort(-_strengths(readings, every, _LOOSE), kind="stable")[:count])
    return chosen, _strengths(readings, chosen, _LOOSE)


class _Readings(NamedTuple):
    """Faces that say something, in some frames: incidence (n, K, G), brightness and weight (n, G)."""

    incident: np.ndarray
    light: np.ndarray
    weight: np.ndarray

    @classmethod
    def of(cls, incident: np.ndarray, light: np.ndarray, weight: np.ndarray, rows: np.ndarray) -> "_Readings":
        """Those of the frames `rows` (bool), of faces that are seen often enough and not black."""
        light, weight = light[rows], weight[rows]
        said = _telling(light, weight)
        return cls(incident[rows][:, :, said], light[:, said], weight[:, said])

    @property
    def count(self) -> int:
        """Number of faces."""
        return self.light.shape[1]


def _telling(light: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Which faces are seen often enough and not black, bool (F,)."""
    return np.asarray(((weight > 0).sum(0) >= _SEEN) & (_mean(light, weight) > _DARK))


def _mean(light: np.ndarray, weight: np.ndarray) -> np.ndarray:
    return (weight * light).sum(0) / np.maximum(weight.sum(0), 1e-12)


def _albedo(light: np.ndarray, weight: np.ndarray, lit: np.ndarray) -> np.ndarray:
    """Albedo of every face that fits best."""
    return (weight * light * lit).sum(0) / np.maximum((weight * lit * lit).sum(0), 1e-12)


def _shine(incident: np.ndarray, strengths: np.ndarray) -> np.ndarray:
    """S of every face and frame, (n, F)."""
    return np.stack([strengths @ one for one in incident]) if len(incident) else np.zeros((0, incident.shape[2]))


def _strengths(readings: _Readings, lights: np.ndarray, ridge: float) -> np.ndarray:
    """Strength of some of the lights, (len(lights),), 4 in all."""
    incident = np.ascontiguousarray(readings.incident[:, lights]).astype(np.float32)
    light, weight = readings.light, readings.weight
    # Dark faces are noisy, and dividing by their albedo makes them loud.
    mean = _mean(light, weight)
    trust = weight * (mean**2 / (mean**2 + 0.25 * np.median(mean) ** 2))
    weight, count = trust, len(lights)
    found = np.full(count, _SUM / count)
    for _ in range(_CONVEX):
        power = np.maximum((weight * light**2).sum(0), 1e-12)
        mixed = sum(one * (w * i).astype(np.float32) for one, w, i in zip(incident, weight, light, strict=True))
        form = _squares(incident, weight) - ((mixed / power.astype(np.float32)) @ mixed.T).astype(np.float64)
        found = _least(form, np.zeros(count), ridge, fixed_sum=True)
        shine = _shine(incident, found)
        inverse = (weight * light * shine).sum(0) / power
        weight = trust / (1.0 + ((inverse * light - shine) / _ROBUST) ** 2)
    for _ in range(_TURNS):
        albedo = np.maximum(_albedo(light, weight, shine), 1e-4)
        relative = light / albedo
        weight = trust / (1.0 + ((relative - shine) / _ROBUST) ** 2)
        pull = sum(one @ (w * r) for one, w, r in zip(incident, weight, relative, strict=True))
        found = _least(_squares(incident, weight), np.asarray(pull), ridge, fixed_sum=False)
        shine = _shine(incident, found)
    return found


def _squares(incident: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Normal matrix of S in the strengths, (K, K)."""
    return np.asarray(
        sum((one * w.astype(np.float32)) @ one.T for one, w in zip(incident, weight, strict=True)), np.float64
    )


def _least(form: np.ndarray, pull: np.ndarray, ridge: float, *, fixed_sum: bool) -> np.ndarray:
    """w >= 0 with the least w.form.w - 2 w.pull and a pull towards equal strengths; scaled to the sum.

    With `fixed_sum` the sum is part of the problem, as one heavy equation.
    """
    from scipy.optimize import nnls

    count = len(form)
    stiff = ridge * np.trace(form) / count
    form = 0.5 * (form + form.T) + (stiff + 1e-9 * np.trace(form) / count) * np.eye(count)
    factor = np.linalg.cholesky(form)
    rows, values = factor.T, np.linalg.solve(factor, pull + stiff * _SUM / count)
    if fixed_sum:
        heavy = 1e3 * np.sqrt(np.trace(form) / count)
        rows, values = np.vstack([rows, np.full(count, heavy)]), np.append(values, heavy * _SUM)
    found = nnls(rows, values, maxiter=100 * count)[0]
    total = found.sum()
    return found * (_SUM / total) if total > 0 else np.full(count, _SUM / count)


def _explained(
    incident: np.ndarray, light: np.ndarray, weight: np.ndarray, held: np.ndarray, strengths: np.ndarray
) -> float:
    """Share of the squared deviation from each face's mean, in the frames `held`, that the light explains."""
    shine = _shine(incident, strengths)
    # In the dark of an ear light is divided by next to nothing: one face of albedo 40 outweighed all others.
    lit = _mean(shine[~held], weight[~held]) > _LIT
    there = ((weight[~held] > 0).sum(0) >= _SEEN) & lit
    albedo = _albedo(light[~held], weight[~held], shine[~held])
    mean = _mean(light[~held], weight[~held])
    judged = weight[held] * there
    by_mean = (judged * (light[held] - mean) ** 2).sum()
    by_light = (judged * (light[held] - albedo * shine[held]) ** 2).sum()
    return float(1.0 - by_light / by_mean) if by_mean > 0 else 0.0
