"""Multi-view refit: speed, and error against the truth, on a full-size synthetic subject.

A synthetic subject (5,023 + 778 vertices) is seen by cameras on an arc at 1920x1080; its keypoints get Gaussian noise,
a share of gross outliers (uniform within 150 px) and a share of missing ones. The refit starts from triangulated
keypoints, or with --perturb from the true parameters moved by 5 mm and turned by 3 degrees. Times are those of the
whole refit, triangulation and posing of all vertices included.

    frames_per_s      frames per second of refit, head and hand together
    head_median_mm    median distance of head vertices from the truth [mm]
    hand_median_mm    the same for the hand
"""

import argparse
import time
from typing import Any

import numpy as np

from nbavatar.config.geometry import FitConfig
from nbavatar.data.synthetic.scene import build_bodies
from nbavatar.fitting.stage import Bodies, fit_sequence
from nbavatar.studies.benchmarks.fit_scene import film, make_fit_scene, perturb

__all__ = ["add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the options."""
    parser.add_argument("--frames", type=int, default=120, help="frames (default 120)")
    parser.add_argument("--cameras", type=int, default=8, help="cameras (default 8)")
    parser.add_argument("--noise", type=float, default=2.0, help="standard deviation of keypoints [px] (default 2)")
    parser.add_argument("--outliers", type=float, default=0.2, help="share of gross outliers (default 0.2)")
    parser.add_argument("--missing", type=float, default=0.2, help="share of missing keypoints (default 0.2)")
    parser.add_argument("--mesh", choices=("full", "tiny"), default="full", help="size of the models (default full)")
    parser.add_argument("--perturb", action="store_true", help="start from perturbed parameters, not from keypoints")
    parser.add_argument("--seed", type=int, default=0)


def run(args: argparse.Namespace) -> dict[str, Any]:
    """Films, fits and compares."""
    bodies = build_bodies(args.mesh)
    scene = make_fit_scene(bodies, args.frames, seed=args.seed)
    wrong = {"noise": args.noise, "outliers": args.outliers, "missing": args.missing}
    extras = film(scene, args.cameras, **wrong, seed=args.seed + 1)
    if args.perturb:
        extras |= perturb(scene.parameters, millimetres=5, degrees=3, seed=args.seed + 2)
    models = Bodies(bodies.flame, {"right": bodies.mano})
    frames = [f"{n:06d}" for n in range(args.frames)]
    begin = time.perf_counter()
    fitted, report = fit_sequence(frames, {}, extras, models, FitConfig(check_handedness=False))
    seconds = time.perf_counter() - begin
    figures: dict[str, Any] = {"frames_per_s": args.frames / seconds, "seconds": seconds}
    for name, part in (("head", "head"), ("hand", "right_hand")):
        error = 1e3 * np.linalg.norm(fitted.parts[part].verts - scene.verts[part], axis=-1)
        figures |= {f"{name}_median_mm": float(np.median(error)), f"{name}_p95_mm": float(np.percentile(error, 95))}
        figures |= {f"{name}_sigma_px": report[part]["sigma_px"], f"{name}_steps": report[part]["steps"]}
    return figures | {"frames": args.frames, "cameras": args.cameras, "mesh": args.mesh}
