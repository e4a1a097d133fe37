"""The stages before training: what their knobs cost, and how far the result moves [mm].

    contact    sweeps over the constraints, and steps of a hand's path, of the contact solver: distance from its
               converged answer, and from the dataset's own deformation where there is one
    refit      cameras and iterations of the multi-view refit: distance from the truth of a synthetic subject
    spectral   number of modes: what of the rest shape's geometry they carry
    decimate   coarser meshes (quadric edge collapse, pymeshlab), carried along by the original's surface: how far the
               original's vertices are from them, over the sequence

Every row: stage, knob, value, milliseconds (a frame, or once where a stage has no frames), error and its meaning.
"""

import dataclasses
import time
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from nbavatar.config.geometry import DeformConfig, FitConfig
from nbavatar.config.tradeoff import OfflineConfig
from nbavatar.data.sequences import MeshSequence
from nbavatar.errors import DataError, require
from nbavatar.mesh.bvh import DeformingMesh, surface_points
from nbavatar.mesh.decimation import decimate_mesh
from nbavatar.studies.tradeoff.contact import ContactScene, contact_scene

__all__ = ["contact_rows", "decimate", "decimation_rows", "refit_rows", "spectral_rows"]

_CONVERGED = {"iterations": 64, "settle": 16}
_NEAR = 1.0  # search radius around the head [m]


def contact_rows(sequence: MeshSequence, sheet: OfflineConfig) -> Iterator[dict[str, Any]]:
    """The contact solver on the frames with the deepest contact; nothing where no hand touches a head.

    Args:
        sequence: head not deformed by contact, hands; `deformation.head` of the dataset if there.
        sheet: values of `iterations` and `settle` (steps after the hand has arrived), number of frames.
    """
    scene = contact_scene(sequence, sheet.contact_frames)
    if scene is None:
        return
    base, head, frames = DeformConfig(), sequence.parts["head"], scene.deepest
    truth = _solved(scene, dataclasses.replace(base, **_CONVERGED))[0]
    settings: list[tuple[str, int]] = [("iterations", v) for v in sheet.contact_iterations]
    settings += [("settle", v) for v in sheet.contact_settle]
    for knob, value in settings:
        verts, ms, depth = _solved(scene, dataclasses.replace(base, **{knob: value}))
        apart = 1e3 * np.linalg.norm(verts - truth, axis=-1)
        moved = np.linalg.norm(truth - head.verts[frames], axis=-1) > 2e-4
        row = _row("contact", knob, value, ms, "mean distance from the converged answer, moved vertices")
        row |= {"error_mm": float(apart[moved].mean()) if moved.any() else 0.0, "worst_mm": float(apart.max())}
        row |= {"depth_mm": 1e3 * depth}
        reference = sequence.extras.get("deformation.head")
        if reference is not None:
            labels = np.linalg.norm(reference[frames], axis=-1) > 2e-4
            gap = 1e3 * np.linalg.norm(verts - head.verts[frames] - reference[frames], axis=-1)
            row["reference_mm"] = float(gap[labels].mean()) if labels.any() else None
        yield row


def refit_rows(sheet: OfflineConfig) -> Iterator[dict[str, Any]]:
    """The refit of a synthetic subject with a known answer, by cameras and by iterations."""
    from nbavatar.data.synthetic.scene import build_bodies
    from nbavatar.fitting.stage import Bodies, fit_sequence
    from nbavatar.studies.benchmarks.fit_scene import film, make_fit_scene

    bodies = build_bodies(sheet.refit_mesh)
    scene = make_fit_scene(bodies, sheet.refit_frames)
    models = Bodies(bodies.flame, {"right": bodies.mano})
    frames = [f"{n:06d}" for n in range(sheet.refit_frames)]
    most = max([*sheet.refit_cameras, 2])
    settings = [("cameras", v, v, FitConfig().iterations) for v in sheet.refit_cameras]
    settings += [("iterations", v, most, v) for v in sheet.refit_iterations]
    for knob, value, cameras, iterations in settings:
        extras = film(scene, cameras, noise=2.0, outliers=0.1, missing=0.1, seed=1)
        began = time.perf_counter()
        config = FitConfig(check_handedness=False, iterations=iterations)
        fitted, _ = fit_sequence(frames, {}, extras, models, config)
        ms = 1e3 * (time.perf_counter() - began) / len(frames)
        errors = {
            part: 1e3 * np.linalg.norm(fitted.parts[part].verts - scene.verts[part], axis=-1) for part in scene.verts
        }
        row = _row("refit", knob, value, ms, "median distance from the truth, head and hand vertices")
        row["error_mm"] = float(np.median(np.concatenate([e.ravel() for e in errors.values()])))
        yield row | {"worst_mm": float(max(e.max() for e in errors.values()))}


def spectral_rows(sequence: MeshSequence, sheet: OfflineConfig) -> Iterator[dict[str, Any]]:
    """Spectral coordinates: time of the solve, and what is lost of the rest shapes when only the modes are kept."""
    from nbavatar.mesh.spectral import spectral_coordinates

    for modes in sheet.spectral_modes:
        began = time.perf_counter()
        solved = {name: spectral_coordinates(p.rest, p.faces, modes) for name, p in sequence.parts.items()}
        ms = 1e3 * (time.perf_counter() - began)
        errors = [
            np.linalg.norm(_remainder(np.asarray(part.rest, np.float64), solved[name]), axis=-1)
            for name, part in sequence.parts.items()
        ]
        row = _row("spectral", "modes", modes, ms, "mean distance of the rest shape from its part in the modes")
        merged = 1e3 * np.concatenate(errors)
        yield row | {"error_mm": float(merged.mean()), "worst_mm": float(merged.max())}


def decimation_rows(sequence: MeshSequence, sheet: OfflineConfig) -> Iterator[dict[str, Any]]:
    """Coarser meshes of all parts: faces left, and how far the original is from them over the sequence."""
    require("pymeshlab", "pymeshlab", "coarser meshes")  # its own start takes seconds, and is no part of the stage
    frames = np.unique(np.linspace(0, len(sequence.frames) - 1, sheet.decimate_frames).astype(int))
    for share in sheet.decimate_shares:
        began = time.perf_counter()
        coarse = decimate(sequence, share)
        ms = 1e3 * (time.perf_counter() - began)
        errors = []
        for name, part in sequence.parts.items():
            mesh = DeformingMesh(coarse.parts[name].rest, coarse.parts[name].faces)
            used = np.unique(part.faces)
            for frame in frames:
                verts = np.asarray(part.verts[frame], np.float64)
                if not np.isfinite(verts).all():
                    continue
                posed = np.asarray(coarse.parts[name].verts[frame], np.float64)
                mesh.move(posed)
                face, weight, _ = _closest(mesh, verts[used])
                nearest = surface_points(posed, coarse.parts[name].faces, face, weight)
                errors.append(1e3 * np.linalg.norm(nearest - verts[used], axis=-1))
        merged = np.concatenate(errors) if errors else np.zeros(1)
        row = _row("decimate", "share of faces", share, ms, "mean distance of the original's vertices")
        row |= {"error_mm": float(merged.mean()), "worst_mm": float(merged.max())}
        yield row | {"faces": sum(len(part.faces) for part in coarse.parts.values())}


def decimate(sequence: MeshSequence, share: float) -> MeshSequence:
    """The sequence with coarser meshes: quadric edge collapse in rest pose, posed by riding on the original's surface.

    Args:
        sequence: meshes of all parts; extras are not kept, since they belong to the original's vertices.
        share: of the faces to keep, in (0, 1].

    Raises:
        DataError: a part would have no face left.
    """
    from nbavatar.data.sequences import Part

    parts = {}
    for name, part in sequence.parts.items():
        rest = np.asarray(part.rest, np.float64)
        verts, faces, face, weight = decimate_mesh(rest, part.faces, max(4, round(share * len(part.faces))))
        if not len(faces):
            raise DataError.of("decimate", name, expected="at least one face", found="none", fix="keep a larger share")
        posed = [
            surface_points(np.asarray(points, np.float64), part.faces, face, weight).astype(np.float32)
            for points in part.verts
        ]
        parts[name] = Part(faces, verts.astype(np.float32), np.stack(posed))
    return MeshSequence(list(sequence.frames), parts, {})


def _closest(mesh: DeformingMesh, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Face, corner weights and distance of the nearest point of a surface, for points (P, 3)."""
    distance, face, weight = mesh.closest(points, _NEAR)
    return face, weight, distance


def _solved(scene: ContactScene, cfg: DeformConfig) -> tuple[np.ndarray, float, float]:
    """Deformed heads (N, V, 3) of the deepest frames, each from rest; milliseconds a frame; overlap left [m]."""
    solver = scene.solver(cfg)
    verts, spent, depth = [], [], 0.0
    for frame in scene.deepest:
        began = time.perf_counter()
        result = scene.solve(solver, int(frame))
        spent.append(1e3 * (time.perf_counter() - began))
        verts.append(result.head)
        depth = max(depth, result.depth[1])
    return np.stack(verts), float(np.median(spent)), depth


def _remainder(rest: np.ndarray, solved: Any) -> np.ndarray:
    """What is left of each vertex when every component is replaced by its part in constant and modes [m]."""
    left = np.zeros_like(rest)
    for component in range(solved.component.max(initial=-1) + 1):
        own = np.flatnonzero(solved.component == component)
        used = np.isfinite(solved.eigenvalues[component])
        basis = np.column_stack((np.ones(len(own)), solved.coords[own][:, used]))
        left[own] = rest[own] - basis @ np.linalg.lstsq(basis, rest[own], rcond=None)[0]
    return left


def _row(stage: str, knob: str, value: float, ms: float, meaning: str) -> dict[str, Any]:
    empty: Mapping[str, Any] = {"depth_mm": None, "reference_mm": None, "faces": None}
    return {"stage": stage, "knob": knob, "value": value, "ms": round(ms, 3), **empty, "meaning": meaning}
