"""The command line: `nbavatar <verb>`.

Each verb is one module of this package with `add_arguments(parser)` and `main(args)`. Only the verb that was
asked for is imported, so `nbavatar --help` and light stages start at once.
"""
# provenance: neutral, because it parses arguments.

import argparse
import contextlib
import errno
import importlib
import os
import sys
from collections.abc import Sequence

from nbavatar import __version__
from nbavatar.errors import ConfigError, NBAvatarError, describe, did_you_mean, limit_of
from nbavatar.packages import distribution_of, install_line
from nbavatar.waiting import wait_briefly

__all__ = ["SOCKET_VARIABLE", "VERBS", "main"]

VERBS = {
    "synthesize": "write a complete synthetic dataset in Decaf's layout, body models included",
    "check": "validate a capture (or a Decaf folder) and draw meshes over its images",
    "import": "data of VHAP, nerfstudio, COLMAP, or mesh files -> a capture",
    "ingest": "one camera's video or image folder -> frame pack",
    "tracks": "a subject's parameters, keypoints and meshes -> one mesh sequence",
    "masks": "person matte + meshes -> head and hand labels and coverage",
    "crop": "undistort, crop and resize frames and labels, intrinsics carried along",
    "segment": "masks from pictures alone: head and hands by SAM 3, or the person by a small network",
    "detect": "keypoints of face and hands in images, for captures that bring none",
    "fit": "multi-view refit of head and hand models",
    "align": "rigid alignment of a capture's meshes to its pictures",
    "shell": "what the head's mesh lacks (hair), carved from the training masks",
    "light": "the light of a capture's studio, from how skin changes as it turns",
    "spectral": "spectral coordinates of the meshes",
    "deform": "contact deformation of the head by the hand, cached to NPZ and EXR",
    "train": "train an avatar",
    "render": "render an avatar under a protocol",
    "evaluate": "PSNR, SSIM and LPIPS of stored renders",
    "speed": "time rasterization and neural rendering of an avatar",
    "collect": "all numbers of a run as one tidy table for pandas",
    "table": "one table of the paper, printed and reproduced values side by side",
    "protocol-sensitivity": "how the figures of one render move with the protocol",
    "figure": "one figure for print: comparisons, features, cross-reenactment, contact, curves, Pareto fronts",
    "reenact": "drive one subject by another's poses",
    "video": "a turntable or a driven sequence as mp4",
    "view": "an avatar in the browser: orbit, play, compare",
    "export": "an avatar or its meshes as .ply, .glb, .obj, .safetensors or .onnx",
    "compare": "quality against the time of training: variants, budgets, seeds",
    "report": "one self-contained HTML page with tables and pictures",
    "tradeoff": "speed against quality of an avatar, setting by setting; presets",
    "extremes": "every numerical kernel at its limits, against an oracle: exact, degrades or refuses",
    "bench": "benchmarks: rasterizer, decoder, training step, viewer, growth and others",
    "run": "the whole pipeline in one command: smoke, capture, compare, paper or rehearsal",
    "warm": "run a command, such as snakemake, in which the verbs that need torch start at once",
    "completion": "what bash, zsh or tcsh needs to complete these commands and their options",
    "doctor": "what this machine can do, and what is missing for which stage",
    "schema": "write the configuration's JSON schema and reference page",
}

SOCKET_VARIABLE = "NBAVATAR_WARM"
"""Environment variable with the socket of `nbavatar warm`; set for its command and everything below that."""

# The verbs that are handed over to it.
_WITH_TORCH = frozenset({"train", "render", "evaluate", "speed", "tradeoff", "extremes", "video", "figure"})


# Errors of the system that only a defect of ours explains; all others are about the user's files, disks and limits.
_OURS = (errno.EBADF, errno.EFAULT, errno.ENOTSOCK)


# Options that name files to write, of all verbs and of single ones. Others that name files which are there are inputs.
_OUTPUTS = ("out", "history", "overview", "record", "csv", "exr", "picture", "validate")
_OUTPUTS_OF = {"deform": ("table",), "detect": ("sheet",), "fit": ("sheet",)}


def _keep_inputs(parsed: argparse.Namespace, outputs: Sequence[str]) -> None:
    """Refuses to write a result in the place of an input.

    Raises:
        ConfigError: an output is one of the files to read, by whatever name or link.
    """
    options = {name: value if isinstance(value, (list, tuple)) else [value] for name, value in vars(parsed).items()}
    for output in outputs:
        for out in options.get(output, []):
            if not isinstance(out, (str, os.PathLike)) or not os.path.isfile(out):
                continue
            for name, values in options.items():
                given = [value for value in values if isinstance(value, (str, os.PathLike)) and os.path.isfile(value)]
                if name != output and any(os.path.samefile(out, value) for value in given):
                    fix = "name another file: this one would be replaced"
                    role = "output" if name in outputs else "input"
                    found = f"the {role} of --{name.replace('_', '-')}"
                    raise ConfigError.of(out, f"--{output}", expected="a file to write", found=found, fix=fix)


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one verb; returns the exit code (0 done, 2 bad input or usage, 130 interrupted)."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    wait_briefly()
    parser = _top_parser()
    if not arguments or arguments[0].startswith("-"):
        parser.parse_args(arguments)
        parser.print_help()
        return 0 if arguments else 2
    verb = arguments[0]
    if verb not in VERBS:
        print(f"nbavatar: error: unknown verb '{verb}'; {did_you_mean(verb, VERBS)}", file=sys.stderr)
        return 2
    if argv is None and verb in _WITH_TORCH and SOCKET_VARIABLE in os.environ:
        from nbavatar.cli.warm import call

        code = call(arguments)
        if code is not None:
            return code
    try:
        module = importlib.import_module(f"nbavatar.cli.{verb.replace('-', '_')}")
        own = argparse.ArgumentParser(
            prog=f"nbavatar {verb}",
            description=module.__doc__,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        module.add_arguments(own)
        parsed = own.parse_args(arguments[1:])
        _keep_inputs(parsed, (*_OUTPUTS, *_OUTPUTS_OF.get(verb, ())))
        return module.main(parsed) or 0
    except NBAvatarError as error:
        message = str(error)
    except KeyboardInterrupt:
        print(f"nbavatar {verb}: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        with contextlib.suppress(OSError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except ModuleNotFoundError as error:
        if error.name is None or error.name.split(".")[0] == "nbavatar":
            raise
        module_name = error.name.partition(".")[0]
        message = f"package '{distribution_of(module_name)}' is not installed; run: {install_line(module_name)}"
    except OSError as error:
        if error.errno is None or error.errno in _OURS:
            raise
        message = "; ".join(filter(None, (f"{_place(error)}: {error.strerror}", limit_of(error))))
    except MemoryError as error:
        message = f"out of memory: {error or 'the data are too large for this machine'}"
    print(f"nbavatar {verb}: error: {message}", file=sys.stderr)
    return 2


def _place(error: OSError) -> str:
    """The file that an error of the system is about, in one line."""
    if error.filename is None:
        return "file system"
    name = os.fsdecode(error.filename) if isinstance(error.filename, (str, bytes)) else str(error.filename)
    return describe(name) if len(name) > 200 or not name.isprintable() else name


def _top_parser() -> argparse.ArgumentParser:
    lines = "\n".join(f"  {verb:<21} {text}" for verb, text in VERBS.items())
    parser = argparse.ArgumentParser(
        prog="nbavatar",
        usage="nbavatar <verb> [options]",
        description="Head avatars with hand-face contact, made of neural billboards.",
        epilog=f"verbs, in the order of the pipeline:\n{lines}\n\n`nbavatar <verb> --help` says more. "
        "`nbavatar run` makes the whole pipeline, by snakemake (see README.md); every verb also works alone.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"nbavatar {__version__}")
    return parser
