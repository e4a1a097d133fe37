"""What a shell needs to complete `nbavatar`: its verbs, their options, files.

    nbavatar completion bash > ~/.local/share/bash-completion/completions/nbavatar
    nbavatar completion zsh  > ~/.zfunc/_nbavatar        (with ~/.zfunc in fpath, before compinit)
    nbavatar completion tcsh > ~/.nbavatar.complete      (and `source` it)

Write it anew after an update of this package. Needs the package shtab (extra `completion`).
"""

import argparse
import importlib

from nbavatar.errors import require

__all__ = ["add_arguments", "main", "whole_parser"]

_FOLDERS = ("DIR", "FOLDER")
_FILES = ("NPZ", "ZIP", "PT", "JSON", "JSON|FILE", "PNG", "MP4", "CSV", "MD", "JSONL", "MODEL", "MODEL|FOLDER", "PATH")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the options of `nbavatar completion`."""
    parser.add_argument("shell", choices=("bash", "zsh", "tcsh"), help="which shell")


def main(args: argparse.Namespace) -> int:
    """Prints the script."""
    shtab = require("shtab", "shtab", "nbavatar completion")
    print(shtab.complete(whole_parser(shtab.FILE, shtab.DIRECTORY), shell=args.shell))
    return 0


def whole_parser(file: object = None, folder: object = None) -> argparse.ArgumentParser:
    """One parser of all verbs with their options; files and folders get these as their attribute `complete`."""
    from nbavatar.cli import VERBS

    top = argparse.ArgumentParser(prog="nbavatar", description="Head avatars with hand-face contact.")
    verbs = top.add_subparsers(dest="verb")
    for verb, text in VERBS.items():
        own = verbs.add_parser(verb, help=text)
        importlib.import_module(f"nbavatar.cli.{verb.replace('-', '_')}").add_arguments(own)
        for action in own._actions:
            if action.metavar in (*_FILES, *_FOLDERS):
                action.complete = folder if action.metavar in _FOLDERS else file  # type: ignore[attr-defined]
    return top
