"""Benchmarks of single kernels on a realistic scene; figures as JSON with --json.

    nbavatar bench raster    billboard rasterizer, forward and backward, against the reference
    nbavatar bench splat     rasterizer of 3D Gaussians, forward and backward, against the reference
    nbavatar bench deform    contact physics, frames a second with and without contact
    nbavatar bench spectral  spectral coordinates of a head and hands
    nbavatar bench fit       multi-view refit, frames a second and millimetres
    nbavatar bench train     one training step, part by part
    nbavatar bench decoder   the U-Net by torch and by inference engines, in turns
    nbavatar bench viewer    pictures a second that the viewer draws, by torch and by inference engines, in turns
    nbavatar bench scaling   time and memory against size: exponents and plots
    nbavatar bench waiting   training steps whose threads wait for each other in two ways, in turns

Times depend on the machine and on what else it does: compare figures of one run only.
"""

import argparse
import importlib
import json
import sys

from nbavatar.cli.run import pipeline_folder

__all__ = ["add_arguments", "main"]

_OF_CAPTURES = ("decoder", "scaling", "waiting")  # measure a capture's training unless another run is named
_KERNELS = ("raster", "splat", "deform", "spectral", "fit", "train", "decoder", "viewer", "scaling", "waiting")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the kernel's name; each kernel has options of its own."""
    names = ",".join(_KERNELS)
    parser.usage = f"nbavatar bench {{{names}}} [--json] [options of the kernel, see --help after it]"
    parser.add_argument("kernel", choices=_KERNELS, help="what to measure")
    parser.add_argument("rest", nargs=argparse.REMAINDER, help=argparse.SUPPRESS)


def main(args: argparse.Namespace) -> int:
    """Runs one benchmark and prints its figures."""
    module = importlib.import_module(f"nbavatar.studies.benchmarks.{args.kernel}")
    parser = argparse.ArgumentParser(
        prog=f"nbavatar bench {args.kernel}",
        description=module.__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of lines")
    module.add_arguments(parser)
    options = parser.parse_args(args.rest)
    if args.kernel in _OF_CAPTURES and options.config is None:
        options.config = str(pipeline_folder() / "config/capture.yaml")
    figures = module.run(options)
    if options.json:
        json.dump(figures, sys.stdout, indent=1, sort_keys=True)
        print()
    else:
        for name, value in figures.items():
            print(f"{name:<24} {value:.6g}" if isinstance(value, float) else f"{name:<24} {value}")
    return 0
