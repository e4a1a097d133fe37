"""Spectral coordinates of a head and two hands: simple shapes of FLAME's and MANO's size, or your own meshes."""

import argparse
import time

from nbavatar.config.geometry import SpectralConfig
from nbavatar.data.sequences import read_sequence
from nbavatar.mesh.spectral import spectral_coordinates
from nbavatar.physics.shapes import capsule_hand, round_head

__all__ = ["add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the options."""
    parser.add_argument("--modes", type=int, default=SpectralConfig().modes, help="modes per part")
    parser.add_argument("--meshes", metavar="NPZ", help="mesh sequence whose rest meshes to take")


def run(args: argparse.Namespace) -> dict[str, float | int]:
    """Solves every part once, after one small solve that loads the libraries."""
    if args.meshes:
        sequence, _ = read_sequence(args.meshes)
        parts = [(part.rest, part.faces) for part in sequence.parts.values()]
    else:
        hand = capsule_hand(778, fingers=1)
        parts = [round_head(5023), hand, hand]
    spectral_coordinates(*round_head(200), 3)
    begin = time.perf_counter()
    found = [spectral_coordinates(rest, faces, args.modes) for rest, faces in parts]
    seconds = time.perf_counter() - begin
    return {
        "seconds": seconds,
        "max_residual": max(float(result.residual.max()) for result in found),
        "modes": args.modes,
        "vertices": sum(len(rest) for rest, _ in parts),
    }
