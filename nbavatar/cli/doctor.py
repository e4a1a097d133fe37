"""What this machine can do, and what is missing for which stage.

Looks at processors, memory, disk and GPUs, imports every package that any verb needs (which finds missing system
libraries too), compiles and runs a small kernel, looks for the LPIPS weights and for the body models and the dataset,
and prints one line per finding. Nothing is changed. Exit code 0 if the synthetic pipeline (`nbavatar run smoke`) can
run, 2 if a package for it is missing or no kernel can be compiled; body models and dataset are needed for the paper
only and do not count. With --brief one line: that all is well, or the first thing that is missing and what to do.
With --gpu one line about the GPU instead: whether its kernels compute what the float64 reference computes, forward
and backward, and how long a frame takes; exit code 2 if they do not. It is found once for a card and a version, and
`train` finds it before the first training on a GPU. With --plan what `nbavatar run paper` will cost on the real
dataset, by rule, here and on a GPU, and what smaller budgets would save and give up. With --json all the other findings
as one JSON object:

  machine      processors, memory_gb, disk_free_gb, gpus [names]
  kernel       null, or why no kernel can be compiled and run
  packages     module -> version, or null with the reason in `broken`
  needs        module -> verbs whose code imports it, in part or as a whole
  limited      module -> what is missing on this system, where only a part of one verb needs the package
  verbs        verb -> modules that are missing
  weights      lpips net -> file, or null
  resources    FLAME, MANO, landmarks, dataset -> path, or null with where to get it in `get`
"""

import argparse
import ast
import functools
import importlib
import importlib.metadata
import importlib.util
import json
import os
import shutil
import sys
from pathlib import Path
from typing import Any

from nbavatar.cli.doctor_plan import add_plan_arguments, plan_costs, plan_lines
from nbavatar.devices import lease_device
from nbavatar.errors import NBAvatarError
from nbavatar.gpus import list_gpus
from nbavatar.packages import distribution_of, extra_of, install_line, installed, remedy
from nbavatar.provenance import code_modules

__all__ = ["add_arguments", "examine", "main", "third_party"]

# What cannot be done where a package is installed but lacks a library of the system; everything else can.
_PARTIAL = {"pymeshlab": "the coarser meshes of `nbavatar tradeoff --offline`"}
_OPTIONAL = {
    "anny": "a realistic synthetic head",
    "cupy": "GPU",
    "gsplat": "another backend for 3D Gaussians on a GPU",
    "pycolmap": "another reader of COLMAP's files",
    "transformers": "masks by SAM 3",
    "wandb": "curves of a training in Weights & Biases",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the options."""
    form = parser.add_mutually_exclusive_group()
    form.add_argument("--json", action="store_true", help="print one JSON object instead of text")
    form.add_argument("--brief", action="store_true", help="print one line: all is well, or what is missing first")
    form.add_argument("--gpu", action="store_true", help="compare this machine's GPU with the reference and time it")
    parser.add_argument("--again", action="store_true", help="with --gpu: do it anew, where it was done before")
    parser.add_argument("--plan", action="store_true", help="say what the paper's run will cost instead")
    add_plan_arguments(parser)
    parser.add_argument(
        "--root",
        default="resources/DecafDataset",
        metavar="DIR",
        help="where the dataset and the body models should be",
    )


def main(args: argparse.Namespace) -> int:
    """Prints the findings; 2 if the synthetic pipeline cannot run, or the GPU computes something else."""
    if args.gpu:
        return _gpu(args.again)
    if args.plan:
        plan = plan_costs(args.frames, args.gpu_ms, _processors())
        print(json.dumps(plan, indent=1) if args.json else "\n".join(plan_lines(plan)))
        return 0
    found = examine(Path(args.root))
    if args.json:
        print(json.dumps(found, indent=1, sort_keys=True))
    else:
        print("\n".join(_brief(found) if args.brief else _lines(found)))
    return 2 if found["missing"] or found["kernel"] else 0


def _gpu(again: bool) -> int:
    """One line about the GPU; 2 where it is wrong.

    Raises:
        DeviceError: there is none.
    """
    with lease_device("cuda") as device:
        from nbavatar.cli.gpu_verdict import gpu_verdict
        from nbavatar.studies.benchmarks.device_check import verdict

        found, known = gpu_verdict(device, again=again)
    print(verdict(found) + (" (found before; --again looks anew)" if known else ""))
    return 0 if found["right"] else 2


def third_party(verb: str) -> set[str]:
    """Top-level names of the packages outside the standard library that a verb's code imports, anywhere in it."""
    names = set[str]().union(*map(_imported, code_modules(verb)))
    return {name for name in names if name not in sys.stdlib_module_names and name != "nbavatar"}


@functools.cache  # most verbs share most modules
def _imported(module: str) -> frozenset[str]:
    """Top-level names of the packages that a module's code imports, anywhere in it."""
    names: set[str] = set()
    spec = importlib.util.find_spec(module)
    if spec is None or spec.origin is None:
        return frozenset()
    for node in ast.walk(ast.parse(Path(spec.origin).read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names.update(alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            names.add(node.module.partition(".")[0])
        elif isinstance(node, ast.Call) and getattr(node.func, "id", "") == "require" and node.args:
            if isinstance(node.args[0], ast.Constant):
                names.add(str(node.args[0].value).partition(".")[0])
    return frozenset(names)


def examine(root: Path) -> dict[str, Any]:
    """All findings as plain values; see the module for the keys."""
    from nbavatar.checks.decaf_inventory import SOURCES
    from nbavatar.cli import VERBS
    from nbavatar.data.decaf_files import Assets, list_subjects

    needed = {verb: third_party(verb) for verb in VERBS if verb != "doctor"}
    packages: dict[str, str | None] = {}
    broken: dict[str, str] = {}
    for name in sorted(set().union(*needed.values()) | {"snakemake"}):
        try:
            importlib.import_module(name)
            packages[name] = _version(name)
        except Exception as error:  # a broken package may raise anything
            packages[name] = None
            broken[name] = _reason(error)
    limited = {name: broken[name] for name in broken if name in _PARTIAL and installed(name)}
    lacking = {name for name in broken if name not in limited and not _optional(name)}
    needed["run"] = needed.get("run", set()) | {"snakemake"}
    verbs = {verb: sorted(modules & lacking) for verb, modules in needed.items()}
    resources: dict[str, str | None] = {}
    get: dict[str, str] = {}
    for name, path in zip(("flame", "landmarks", "mano"), Assets(root / "assets").body_models, strict=True):
        resources[name] = str(path) if path.is_file() else None
        if resources[name] is None:
            get[name] = f"{SOURCES[name]}; put at {path}"
    subjects = list_subjects(root) if root.is_dir() else {}
    resources["dataset"] = f"{root} ({', '.join(sorted(subjects))})" if subjects else None
    if not subjects:
        get["dataset"] = f"{SOURCES['decaf']}; put at {root}"
    missing = sorted({name for names in verbs.values() for name in names})
    return {
        "machine": _machine(),
        "kernel": _kernel_problem(),
        "limited": limited,
        "needs": {name: [verb for verb, modules in needed.items() if name in modules] for name in packages},
        "packages": packages,
        "broken": broken,
        "verbs": verbs,
        "weights": _weights(),
        "resources": resources,
        "get": get,
        "missing": missing,
    }


def _optional(name: str) -> bool:
    """Whether the pipeline runs without a module: it belongs to an extra of its own, or to none."""
    return name in _OPTIONAL or extra_of(name) not in (None, "pipeline")


def _kernel_problem() -> str | None:
    """None if Numba can compile a kernel here and the kernel adds up numbers, otherwise the reason in one line."""
    try:
        import numba
        import numpy as np

        @numba.njit(nogil=True)
        def total(values: Any) -> float:
            result = 0.0
            for i in range(values.size):
                result += values[i]
            return result

        found = total(np.arange(5.0))
        return None if found == 10.0 else f"a compiled sum of 0 to 4 gave {found}"
    except Exception as error:  # a broken compiler may raise anything
        return _reason(error)


def _reason(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]


def _machine() -> dict[str, Any]:
    pages = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    gpus: list[str] = []
    problem = None
    if list_gpus():
        try:
            import torch

            count = torch.cuda.device_count() if torch.cuda.is_available() else 0
            gpus = [torch.cuda.get_device_name(i) for i in range(count)]
            if count and importlib.util.find_spec("numba_cuda") is None:
                problem = f"no compiler for the CUDA kernels; {install_line('numba-cuda')}"
            if not count:
                problem = f"a GPU is there, but torch {torch.__version__} cannot use it; install a CUDA build of torch"
        except ImportError as error:
            problem = str(error)
    return {
        "python": sys.version.split()[0],
        "processors": _processors(),
        "memory_gb": round(pages / 2**30, 1),
        "disk_free_gb": round(shutil.disk_usage(".").free / 2**30, 1),
        "gpus": gpus,
        "gpu_problem": problem,
    }


def _processors() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _version(name: str) -> str:
    try:
        return importlib.metadata.version(distribution_of(name))
    except importlib.metadata.PackageNotFoundError:
        return str(getattr(sys.modules[name], "__version__", "unknown"))


def _weights() -> dict[str, str | None]:
    try:
        from nbavatar.metrics.lpips import locate_weights
    except ImportError:
        return {}
    found: dict[str, str | None] = {}
    for net in ("alex", "vgg"):
        try:
            found[net] = str(locate_weights(net))
        except NBAvatarError:
            found[net] = None
    return found


def _weights_line() -> str:
    from nbavatar.metrics.lpips import INSTALL

    return f"python -m {INSTALL}"


def _lines(found: dict[str, Any]) -> list[str]:
    machine = found["machine"]
    gpu = [*machine["gpus"], *([machine["gpu_problem"]] if machine["gpu_problem"] else [])]
    lines = [
        f"machine    Python {machine['python']}, {machine['processors']} processors, {machine['memory_gb']} GB memory, "
        f"{machine['disk_free_gb']} GB free on this disk",
        f"GPU        {'; '.join(gpu) or 'none: everything runs on the CPU'}",
        "packages   " + ", ".join(f"{name} {v}" for name, v in found["packages"].items() if v is not None),
    ]
    for name, reason in found["broken"].items():
        verbs = _OPTIONAL.get(name) or ", ".join(found["needs"][name])
        package = distribution_of(name)
        if name in found["limited"]:
            lines.append(f"limited    {package}: {reason}; needed for {_PARTIAL[name]} only; {remedy(name)}")
            continue
        state = "optional  " if _optional(name) else "MISSING   "
        lines.append(f"{state} {package}: {reason}; needed for: {verbs}; {remedy(name)}")
    for net, path in found["weights"].items():
        lines.append(f"LPIPS      {net}: {path or 'no weights; ' + _weights_line()}")
    for name, path in found["resources"].items():
        lines.append(f"{name:<10} {path or 'not there; needed for the paper only. ' + found['get'][name]}")
    ready = [verb for verb, names in found["verbs"].items() if not names]
    lines.append(f"ready      {', '.join(ready)}")
    if found["kernel"]:
        lines.append(f"MISSING    numba cannot compile a kernel: {found['kernel']}")
    if found["missing"]:
        lines.append(f"not ready  {', '.join(verb for verb, names in found['verbs'].items() if names)}")
    else:
        lines.append("`nbavatar run smoke` can run here")
    return lines


def _brief(found: dict[str, Any]) -> list[str]:
    """One line: the first thing without which the pipeline does not run, or that there is none; and what is limited."""
    if found["missing"]:
        name = found["missing"][0]
        others = len(found["missing"]) - 1
        more = f" (and {others} more, see nbavatar doctor)" if others else ""
        reason = found["broken"][name]
        return [f"doctor: {name} cannot be imported: {reason}{more}; {remedy(name)}"]
    if found["kernel"]:
        return [f"doctor: numba cannot compile a kernel: {found['kernel']}; see nbavatar doctor"]
    lines = [f"doctor: {len(found['packages']) - len(found['broken'])} packages can be imported, a kernel compiles"]
    for name, reason in found["limited"].items():
        lines.append(f"doctor: {_PARTIAL[name]} cannot be made, {name} says: {reason}; {remedy(name)}")
    return lines
