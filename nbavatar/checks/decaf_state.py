"""What is there of the Decaf dataset, in one line: whole, partial, packed, elsewhere, or not at all."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from nbavatar.checks.decaf_inventory import Missing
from nbavatar.data.decaf_files import FOLDERS, list_subjects, release_subject

__all__ = ["state_line"]

_MODELS = {"flame": "FLAME", "landmarks": "landmark_embedding.npy", "mano": "MANO"}


def state_line(root: Path, cameras: Mapping[str, Sequence[str]], missing: Sequence[Missing]) -> str:
    """The one line that says what state a dataset of which files are missing is in, and what to do about it.

    Args:
        root: folder of the dataset, which need not exist.
        cameras: subject -> its cameras, as they are wanted.
        missing: result of `missing_files` for the same.
    """
    if not list_subjects(root):
        return f"{root}: expected the Decaf dataset (train/ and test/), found {_instead(root)}"
    parts = []
    gone = [name for name in _MODELS if any(item.source == name for item in missing)]
    if gone:
        parts.append(f"body models missing: {', '.join(_MODELS[name] for name in gone)}")
    indexes = [item.path for item in missing if item.source == "decaf" and "neck_idx" in item.path]
    if indexes:
        parts.append(f"{', '.join(indexes)} missing")
    of = {name: _of_subject(name, ids, missing) for name, ids in cameras.items()}
    absent = [name for name, words in of.items() if words == "absent"]
    empty = [folder for folder in FOLDERS if not (root / folder).is_dir()]
    if absent:
        places = {name: release_subject(root, name).folder for name in absent}
        why = [f"{folder}/ is not there" for folder in empty if folder in places.values()]
        parts.append(f"without {', '.join(absent)}" + (f" ({', '.join(why)})" if why else ""))
    parts += [f"{name} lacks {words}" for name, words in of.items() if words not in ("", "absent")]
    whole = [name for name, words in of.items() if not words]
    line = f"{root}: expected all files of {', '.join(cameras)}, found it {'; '.join(parts)}"
    if whole and not gone and not indexes:
        line += f"; what is whole can be run: nbavatar run paper --subjects {' '.join(whole)}"
    return line


def _of_subject(name: str, cameras: Sequence[str], missing: Sequence[Missing]) -> str:
    """What a subject lacks in words; `absent` where it is nowhere, empty where it is whole."""
    unfound = "{" + ",".join(FOLDERS) + "}/"
    own = [item.path for item in missing if name in Path(item.path).parts or Path(item.path).stem.split("_")[0] == name]
    if any(path.startswith(unfound) for path in own):
        return "absent"
    videos = {Path(path).stem for path in own if Path(path).parts[1:2] == ("videos",)}
    lost = [camera for camera in cameras if camera in videos]
    rest = [path for path in own if Path(path).stem not in lost]
    words = [f"camera{'s' if len(lost) > 1 else ''} {', '.join(lost)}"] if lost else []
    if rest:
        words.append(rest[0] if len(rest) == 1 else f"{rest[0]} and {len(rest) - 1} more files")
    fix = " (a camera that you do not have is left out in config/subjects.tsv)" if lost else ""
    return " and ".join(words) + fix


def _instead(root: Path) -> str:
    """Where the dataset may be instead: packed, a folder deeper or beside, or nowhere near."""
    if root.is_file():
        return f"a file; unpack it: unzip {root} -d {root.parent}"
    for base in (root, root.parent):
        packed = sorted(path for path in base.glob("*.zip") if base == root or "decaf" in path.name.lower())
        if packed:
            return f"it still packed; unpack it: unzip {packed[0]} -d {packed[0].parent}"
    beside = [*sorted(root.glob("*/")), *sorted(root.glob("*/*/")), *sorted(root.parent.glob("*/"))]
    for folder in beside:
        if folder.resolve() != root.resolve() and list_subjects(folder):
            return (
                f"it in {folder}; move it: mv {folder} {root}"
                if folder.parent != root
                else (f"it a folder deeper, in {folder}; move what is in there: mv {folder}/* {root}/")
            )
    return "no such folder" if not root.exists() else "neither"
