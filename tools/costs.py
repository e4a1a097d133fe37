"""What the jobs of a run cost: processor time and peak memory of every `nbavatar` command, and the sheet made of them.

    python tools/costs.py record USAGE.jsonl -- make rehearsal
    python tools/costs.py sheet USAGE.jsonl [MORE.jsonl ...] > config/costs.tsv

`record` runs a command and puts a line into USAGE.jsonl for each `nbavatar` command that it ran on the way: its words,
seconds of processor time and peak memory as the system counted them for the process and its children (`wait4`), and
the size of what it wrote. Snakemake's own files in benchmarks/ sample a process, every half second at first and every
30 seconds later, and so miss the end of a job and short peaks.

`sheet` turns the lines into the rows of config/costs.tsv, from which `nbavatar doctor --plan` reckons. A later line
about the same output replaces an earlier one, so that a run may be recorded in pieces.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
import zipfile
from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from nbavatar.cli.common import read_mapping
from nbavatar.config.tradeoff import read_sheet
from nbavatar.data.sequences import read_sequence
from nbavatar.planning.costs import sweep_pictures

_UNITS = {
    "ingest": "frames", "tracks": "frames", "masks": "frames", "crop": "frames", "fit": "views", "deform": "frames",
    "train": "steps", "render": "images", "evaluate": "images", "speed": "passes", "reenact": "frames",
    "reenact_contact": "frames", "video": "frames", "tradeoff": "pictures",
}  # fmt: skip
"""What the work of a rule is counted in; of the others, a job is a job."""

_NAMED = ("train", "render", "speed")
"""Rules whose jobs differ by the variant, results/<run>/<rule>/<subject>/<variant>/..."""


def record(usage: Path, command: Sequence[str]) -> int:
    """Runs a command with a `nbavatar` in front of the real one that says what it used. Returns its exit code."""
    usage.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        before = Path(folder) / "nbavatar"
        before.write_text(f"#!{sys.executable}\n" + _FRONT.format(tools=str(Path(__file__).resolve())))
        before.chmod(0o755)
        path = os.pathsep.join([folder, str(Path(sys.executable).parent), os.environ.get("PATH", "")])
        environment = {**os.environ, "PATH": path, "NBAVATAR_USAGE": str(usage.resolve())}
        noted = usage.stat().st_size if usage.exists() else 0
        code = subprocess.run(list(command), env=environment, check=False).returncode
    if not usage.exists() or usage.stat().st_size == noted:
        print(f"{usage}: nothing noted: no nbavatar command was run by way of PATH", file=sys.stderr)
    return code


_FRONT = """import runpy, sys
sys.argv[0] = {tools!r}
raise SystemExit(runpy.run_path({tools!r})["timed"](sys.argv[1:]))
"""


def timed(words: Sequence[str]) -> int:
    """Runs `nbavatar WORDS` and notes what it used. Returns its exit code."""
    began = time.monotonic()
    child = subprocess.Popen([sys.executable, "-m", "nbavatar", *words])
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda signum, _: child.send_signal(signum))
    _, status, used = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    line = {
        "words": list(words),
        "code": child.returncode,
        "seconds": round(time.monotonic() - began, 2),
        "cpu_s": round(used.ru_utime + used.ru_stime, 2),
        "peak_mb": round(used.ru_maxrss * (1 if sys.platform == "darwin" else 1024) / 1e6),
        "out_mb": round(_size(_out(words)) / 1e6, 2),
    }
    with open(os.environ["NBAVATAR_USAGE"], "a", encoding="utf-8") as stream:
        stream.write(json.dumps(line) + "\n")
    return child.returncode if child.returncode >= 0 else 128 - child.returncode


def _option(words: Sequence[str], name: str) -> str:
    """The word after an option, or nothing."""
    return words[words.index(name) + 1] if name in words[:-1] else ""


def _out(words: Sequence[str]) -> str:
    """What a command writes, or the beginning of its outputs' names."""
    return _option(words, "--out") or _option(words, "--out-stem")


def _size(out: str) -> int:
    """Bytes of an output; of a model also of what lies in its folder, such as the state to go on from."""
    path = Path(out)
    if path.name == "model.pt":
        path = path.parent
    if path.is_dir():
        return sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
    return path.stat().st_size if out and path.is_file() else 0


def rows_of(lines: Iterable[dict[str, Any]]) -> list[tuple[str, str, str, float, float, float, float]]:
    """Rows of the sheet: (rule, of, unit, units, cpu_s, peak_mb, out_mb), jobs alike joined (means, largest memory)."""
    last: dict[tuple[str, str], dict[str, Any]] = {}
    for line in lines:
        if line["code"] == 0:
            # A sweep and its savings are two rules that write into one folder.
            last[_out(line["words"]), _rule(line["words"])] = line
    groups: dict[tuple[str, str, str, float], list[dict[str, Any]]] = defaultdict(list)
    for (out, rule), line in last.items():
        parts = Path(out).parts
        if rule == "synthesize":
            groups["synthesize", "", "job", 1.0].append(line)
        elif parts[:1] == ("results",) and len(parts) > 2:
            unit = _UNITS.get(rule, "job")
            groups[rule, _of(rule, line["words"], parts[3:]), unit, _count(rule, line["words"], out)].append(line)
    rows = []
    for (rule, of, unit, count), found in groups.items():
        cpu, size = (sum(line[name] for line in found) / len(found) for name in ("cpu_s", "out_mb"))
        rows.append((rule, of, unit, count, round(cpu, 2), max(line["peak_mb"] for line in found), round(size, 2)))
    return sorted(rows)


def _rule(words: Sequence[str]) -> str:
    verb = words[0]
    if verb == "tradeoff":
        return "savings" if "--savings" in words else "offline" if "--offline" in words else "tradeoff"
    reenacted = Path(_out(words)).parts[2:3] == ("reenact",)
    return "reenact_contact" if verb == "deform" and reenacted else verb


def _of(rule: str, words: Sequence[str], parts: Sequence[str]) -> str:
    if rule == "crop":
        return parts[0]
    if rule == "evaluate":
        return str(json.loads(_option(words, "--protocol"))["crop"])
    return Path(parts[1]).stem if rule in _NAMED else ""


def _count(rule: str, words: Sequence[str], out: str) -> float:
    """Units of work of a job, read from what it wrote."""
    if rule not in _UNITS:
        return 1.0
    options = json.loads(_option(words, "--cfg") or "{}")
    if rule == "train":
        return float(options["steps"])
    if rule == "speed":
        return float(options["repeats"] + options["warmup"])
    if rule == "video":
        return float(options["max_frames"])
    if rule == "evaluate":
        return float(json.loads(Path(out).read_text(encoding="utf-8"))["count"])
    if rule == "tradeoff":
        sheet = read_sheet(read_mapping(_option(words, "--sheet"), "--sheet"), "--sheet")
        return float(sweep_pictures(sheet))
    if out.endswith(".zip"):
        with zipfile.ZipFile(out) as pack:
            names = pack.namelist()
        first = names[0].split("/")[0]
        return float(sum(name.startswith(f"{first}/") for name in names))
    frames = len(read_sequence(out)[0].frames)
    if rule == "fit":
        start = words.index("--frames") + 1
        cameras = next(n for n, word in enumerate([*words[start:], "--"]) if word.startswith("--"))
        frames *= cameras
    return float(frames)


def main() -> int:
    """The two commands."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    verbs = parser.add_subparsers(dest="verb", required=True)
    one = verbs.add_parser("record", help="run a command and note what every nbavatar command of it used")
    one.add_argument("usage", type=Path, metavar="USAGE.jsonl")
    one.add_argument("command", nargs=argparse.REMAINDER, help="after --")
    two = verbs.add_parser("sheet", help="print the rows of config/costs.tsv")
    two.add_argument("usage", type=Path, nargs="+", metavar="USAGE.jsonl")
    args = parser.parse_args()
    if args.verb == "record":
        return record(args.usage, args.command[args.command[:1] == ["--"] :])
    lines = [json.loads(line) for path in args.usage for line in path.read_text(encoding="utf-8").splitlines()]
    print("rule\tof\tunit\tunits\tcpu_s\tpeak_mb\tout_mb")
    for row in rows_of(lines):
        print("\t".join(format(value, "g") if isinstance(value, float) else str(value) for value in row))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
