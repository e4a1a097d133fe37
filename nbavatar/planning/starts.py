"""What the trainings of a run start from (`train.start`): nothing, a file, or another avatar of the same run."""

import os
from collections.abc import Iterable, Mapping
from typing import Any

from nbavatar.config.run import RunConfig
from nbavatar.errors import ConfigError, describe, did_you_mean
from nbavatar.names import check_place

__all__ = ["checked_starts", "start_of"]


def start_of(run: RunConfig, subject: str, variant: str) -> str | tuple[str, str]:
    """A file (what ends in `.pt`), or subject and variant of an avatar of the run; empty for nothing.

    The avatar that a start names does not start from itself: a whole run can start from its first subject.

    Raises:
        ConfigError: neither of the two.
    """
    text = _own(run, variant, "start")
    if not text or text.endswith(".pt"):
        return check_place(text, _place(variant), error=ConfigError)
    if text.count("/") != 1:
        expected = "a file (model.pt), or subject/variant of this run"
        raise ConfigError.of(_place(variant), expected=expected, found=describe(text))
    named, of = text.split("/")
    return "" if (named, of) == (subject, variant) else (named, of)


def checked_starts(
    run: RunConfig, subjects: Mapping[str, Any], avatars: Iterable[tuple[str, str]]
) -> list[tuple[str, str]]:
    """All avatars of the run that others start from, in several steps too.

    Args:
        run: the configuration.
        subjects: by name.
        avatars: subject and variant of what is trained for its own sake.

    Raises:
        ConfigError: a start that is not there or not known, of another method, or that comes back to where it began.
    """
    found: dict[tuple[str, str], None] = {}
    for avatar in dict.fromkeys(avatars):
        chain = [avatar]
        while start := start_of(run, *chain[-1]):
            variant = chain[-1][1]
            if isinstance(start, str):
                _check_file(run, variant, start)
                break
            for what, name, known in (("subject", start[0], subjects), ("variant", start[1], run.variants)):
                if name not in known:
                    raise ConfigError(f"{_place(variant)}: unknown {what} '{name}'; {did_you_mean(name, known)}")
            own, its = (_own(run, of, "method") for of in (variant, start[1]))
            if own != its:
                raise ConfigError.of(_place(variant), expected=f"an avatar of the method {own}", found=f"one of {its}")
            if start in chain:
                circle = " from ".join("/".join(one) for one in [*chain[chain.index(start) :], start])
                raise ConfigError.of(_place(variant), expected="a beginning", found=f"a circle: {circle}")
            chain.append(start)
            found[start] = None
    return list(found)


def _check_file(run: RunConfig, variant: str, path: str) -> None:
    made = os.path.abspath(f"results/{run.run}/train")
    if os.path.abspath(path).startswith(made + os.sep):
        fix = "write subject/variant, so that it is made first"
        raise ConfigError.of(_place(variant), expected="a file from elsewhere", found=f"{path} of this run", fix=fix)
    if not os.path.isfile(path):
        raise ConfigError.of(_place(variant), expected="a file (model.pt)", found=f"no such file: {path}")


def _own(run: RunConfig, variant: str, option: str) -> str:
    """One option of a variant's training; a whole stage is resolved far slower."""
    return run.variants[variant].stages.get("train", {}).get(option, getattr(run.stages.train, option))


def _place(variant: str) -> str:
    return f"variants.{variant}: train.start"
