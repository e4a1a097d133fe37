"""The light of the studio, from how the brightness of the same skin changes between frames.

A face of colour a (its albedo) that is turned, and shadowed, in N frames has the brightness

    I(n) = a S(n),    S(n) = sum_k w_k incidence_k(n)

with far lights of strength w_k >= 0 all around (`nbavatar.mesh.incidence`): one product of unknowns for each face, and
one set of w for all. In 1 / a the equations are linear: sum (I(n) / a - S(n))^2 is, with the best a of each face put
in, a quadratic form in w, and its smallest value among w >= 0 of a given sum is a convex problem with one solution. It
favours lights that change little; from there on a and w are found in turns by least squares of I - a S. What a camera
adds by its own place (gloss) counts as noise.

Whether there is such a light is judged by frames that took no part: fitted to two of three frames, it has to explain
how bright the others are better than the mean brightness of each face does. Faces that hardly any light reaches in the
frames of the fit are left out: their albedo cannot be told.

Brightness is that of linear light (sRGB's transfer function undone, IEC 61966-2-1), mean over red, green and blue:
coloured lights are taken for grey ones.
"""

from typing import Any, NamedTuple

import numpy as np

from nbavatar.data.lights import Light
from nbavatar.io.images import linear_light

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
    incident: np.ndarray, seen: Brightness, directions: np.ndarray, *, kept: int, least: float
) -> tuple[Light, dict[str, Any]]:
    """Far lights that explain how the brightness of faces changes.

    Args:
        incident: incidence of every light, float32 (N, K, F); of a part that is not in a frame, anything.
        seen: brightness of the faces.
        directions: towards the K lights, unit, world (K, 3).
        kept: most lights that are kept, the strongest.
        least: share of the change, in frames that took no part, that has to be explained for a light to be kept.

    Returns:
        the light, and what was found, for records: `explained`, `lights`, or `absent` with the reason.
    """
    readings = np.where(seen.pixels > 0, seen.light / np.maximum(seen.pixels, 1.0), 0.0)
    weight = np.minimum(seen.pixels, _MOST)
    nothing = Light(np.zeros((0, 3), np.float32), np.zeros(0, np.float32))
    held = np.arange(len(readings)) % 3 == 1
    fold = _Readings.of(incident, readings, weight, ~held)
    said: dict[str, Any] = {"frames": len(readings), "faces": fold.count}
    if len(readings) < _FRAMES or fold.count < _FACES:
        reason = f"{fold.count} faces are seen in {_SEEN} of {len(readings)} frames"
        return nothing, {
            **said,
            "absent": f"{reason}; at least {_FACES} faces and {_FRAMES} frames tell light from skin",
        }
    every = np.arange(len(directions))
    explained = _explained(incident, readings, weight, held, _strengths(fold, every, _RIDGE))
    said["explained"] = round(explained, 4)
    if explained < least:
        return nothing, {
            **said,
            "absent": f"a light that stands still explains {100 * explained:.0f} % of how skin changes",
        }
    whole = _Readings.of(incident, readings, weight, np.ones(len(readings), bool))
    strongest = np.sort(np.argsort(-_strengths(whole, every, _RIDGE), kind="stable")[:kept])
    found = _strengths(whole, strongest, _LOOSE)
    lit = found > 1e-4 * _SUM
    found = found[lit] * (_SUM / found[lit].sum())
    said["lights"] = int(lit.sum())
    return Light(directions[strongest][lit].astype(np.float32), found.astype(np.float32)), said


class _Readings(NamedTuple):
    """Faces that say something, in some frames: incidence (n, K, G), brightness and weight (n, G)."""

    incident: np.ndarray
    light: np.ndarray
    weight: np.ndarray

    @classmethod
    def of(cls, incident: np.ndarray, light: np.ndarray, weight: np.ndarray, rows: np.ndarray) -> "_Readings":
        """Those of the frames `rows` (bool), of faces that are seen often enough and not black."""
        light, weight = light[rows], weight[rows]
        said = ((weight > 0).sum(0) >= _SEEN) & (_mean(light, weight) > _DARK)
        return cls(incident[rows][:, :, said], light[:, said], weight[:, said])

    @property
    def count(self) -> int:
        """Number of faces."""
        return self.light.shape[1]


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
