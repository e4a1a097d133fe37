"""One subject driven by another's poses: the source's shape in the target's motion.

    by parameters   FLAME and MANO: the source's shape coefficients; the target's expression, jaw, hand pose, rigid pose
    by meshes       deformation transfer (`nbavatar.evaluation.transfer`), for meshes of equal faces

Where the target's hand touches the target's head, the source's hand has to touch the source's head, whatever their
sizes. So each hand is shifted, per frame, by how much the two heads differ there: the mean over the hand's vertices j
of (source head - target head) at the head vertex nearest to j, less (source hand - target hand) at j, weighted by
exp(-(d_j / 2 cm)^2) with d_j their distance in the target. A hand that is far away is not shifted, and the shift fades
in with the nearest distance, so it is as smooth in time as the motion. What is left of contact, penetration and dents,
is the work of `nbavatar deform` on the result.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from nbavatar.bodymodels.flame import Flame
from nbavatar.bodymodels.mano import Mano
from nbavatar.data.sequences import SHELL, MeshSequence, Part
from nbavatar.errors import DataError
from nbavatar.evaluation.transfer import DeformationTransfer

__all__ = ["check_topology", "drive", "has_parameters", "model_vertices"]

_REACH = 0.02
_KEYS = {
    "head": ("shape", "expression", "jaw", "global_orient", "transl"),
    "hand": ("betas", "hand_pose", "global_orient", "transl"),
}


def has_parameters(sequence: MeshSequence, parts: Sequence[str]) -> bool:
    """Whether a sequence carries the body-model parameters of all these parts."""
    return all(f"param.{part}.{key}" in sequence.extras for part in parts for key in _keys(part))


def check_topology(source: MeshSequence, target: MeshSequence, source_name: str, target_name: str) -> list[str]:
    """The parts that both have, after making sure that their faces agree; a shell is each subject's own.

    Raises:
        DataError: no part in common, or a part with other faces or another number of vertices.
    """
    common = [part for part in source.parts if part in target.parts and part != SHELL]
    if not common:
        raise DataError.of(
            target_name, expected=f"one of the parts {', '.join(source.parts)}", found=", ".join(target.parts)
        )
    for part in common:
        a, b = source.parts[part], target.parts[part]
        if a.rest.shape != b.rest.shape or a.faces.shape != b.faces.shape or not np.array_equal(a.faces, b.faces):
            raise DataError.of(
                target_name,
                f"{part}.faces",
                expected=f"the {len(a.faces)} faces and {len(a.rest)} vertices of {source_name}",
                found=f"{len(b.faces)} other faces on {len(b.rest)} vertices"
                if a.faces.shape == b.faces.shape
                else f"{len(b.faces)} faces on {len(b.rest)} vertices",
                fix="poses are carried over between meshes of one topology only",
            )
    return common


def model_vertices(part: str, extras: Mapping[str, np.ndarray], body: Flame | Mano) -> np.ndarray:
    """Vertices of a part from the parameters ``param.<part>.*``, float64 [N, V, 3] [m]."""
    import torch

    values = {key: torch.tensor(np.asarray(extras[f"param.{part}.{key}"], np.float64)) for key in _keys(part)}
    if isinstance(body, Flame):
        return body.forward_decaf(
            values["shape"], values["expression"], values["jaw"], values["global_orient"], values["transl"]
        ).numpy()
    posed = body.forward(values["betas"], values["hand_pose"], values["global_orient"], values["transl"])
    return posed.verts.numpy()


def drive(
    source: MeshSequence,
    target: MeshSequence,
    parts: Sequence[str],
    *,
    bodies: Mapping[str, Flame | Mano] | None = None,
    place: str = "source",
    keep_contact: bool = True,
) -> MeshSequence:
    """The source in the target's poses.

    Args:
        source: whose shape.
        target: whose motion.
        parts: parts to drive, with equal faces in both.
        bodies: part -> body model, to go by parameters; None: by deformation transfer.
        place: ``target`` leaves the motion where it is; ``source`` moves all of it, by one translation, to where the
            source's first part is on average, so that the source's cameras see it.
        keep_contact: shift hands so that they touch the source's head where they touch the target's.

    Returns:
        A sequence of the target's frames with the source's rest shapes and cameras, the target's split and segments,
        ``driver`` (text [N], the target's frame ids: marks these frames as nobody's training frames), the shift of each
        hand ``shift.<hand>`` [N, 3] [m], and the parameters if there are any.
    """
    own, extras = {}, {}
    for part in parts:
        if bodies is None:
            transfer = DeformationTransfer(source.parts[part].rest, target.parts[part].rest, target.parts[part].faces)
            own[part] = np.stack(list(transfer.poses(target.parts[part].verts)))
        else:
            mixed = _mixed_parameters(part, source.extras, target.extras)
            own[part] = model_vertices(part, mixed, bodies[part])
            extras |= mixed
    theirs = {part: np.asarray(target.parts[part].verts, np.float64) for part in parts}
    if bodies is not None:
        # The same model poses both, so that what differs is the shape alone, not a dent or a correction of the target.
        theirs = {part: model_vertices(part, target.extras, bodies[part]) for part in parts}
    shifts = {}
    if keep_contact and "head" in parts:
        for part in parts:
            if part != "head":
                shifts[part] = _contact_shift(theirs["head"], theirs[part], own["head"], own[part])
                own[part] = own[part] + shifts[part][:, None]
    offset = np.zeros(3)
    if place == "source":
        first = parts[0]
        offset = _mean_place(source.parts[first].verts) - _mean_place(own[first])
    for part in parts:
        own[part] = own[part] + offset
        move = offset + shifts.get(part, 0.0)
        if f"param.{part}.transl" in extras:
            extras[f"param.{part}.transl"] = (extras[f"param.{part}.transl"] + move).astype(np.float32)
    extras |= {f"shift.{part}": value for part, value in shifts.items()}
    extras |= {name: value for name, value in source.extras.items() if name.startswith(("camera.", "stiffness."))}
    extras |= {name: target.extras[name] for name in ("split", "segments") if name in target.extras}
    extras["driver"] = np.array(target.frames, dtype=np.str_)
    driven = {
        part: Part(source.parts[part].faces, source.parts[part].rest, own[part].astype(np.float32)) for part in parts
    }
    return MeshSequence(list(target.frames), driven, extras)


def _keys(part: str) -> tuple[str, ...]:
    return _KEYS["head" if part == "head" else "hand"]


def _mixed_parameters(
    part: str, source: Mapping[str, np.ndarray], target: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """The target's parameters with the source's shape, which is the median of its frames."""
    mixed = {f"param.{part}.{key}": np.asarray(target[f"param.{part}.{key}"]) for key in _keys(part)}
    shape = f"param.{part}.{_keys(part)[0]}"
    own = np.median(np.asarray(source[shape], np.float64), axis=0)
    if own.shape != mixed[shape].shape[1:]:
        raise DataError.of(
            "target", shape, expected=f"{own.shape[0]} coefficients as in the source", found=mixed[shape].shape[1]
        )
    mixed[shape] = np.tile(own, (len(mixed[shape]), 1)).astype(np.float32)
    return mixed


def _mean_place(verts: np.ndarray) -> np.ndarray:
    centroids = np.asarray(verts, np.float64).mean(axis=1)
    return np.nanmean(centroids, axis=0)


def _contact_shift(
    target_head: np.ndarray, target_hand: np.ndarray, source_head: np.ndarray, source_hand: np.ndarray
) -> np.ndarray:
    """Shift of the hand in every frame, float64 [N, 3] [m]; 0 where a part is missing."""
    from scipy.spatial import cKDTree

    shifts = np.zeros((len(target_head), 3))
    for row, (head, hand) in enumerate(zip(target_head, target_hand, strict=True)):
        if not (np.isfinite(head).all() and np.isfinite(hand).all()):
            continue
        distance, nearest = cKDTree(head).query(hand)
        weight = np.exp(-((distance / _REACH) ** 2))
        wanted = (source_head[row][nearest] - head[nearest]) - (source_hand[row] - hand)
        shifts[row] = weight.max() * (weight @ wanted) / max(weight.sum(), 1e-12)
    return shifts
