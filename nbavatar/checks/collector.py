"""Defects of a capture as lines, those of one kind and cause told once."""

import re
from collections.abc import Callable
from typing import Any

from nbavatar.errors import DataError

__all__ = ["Collector"]


class Collector:
    """Collects defects; many of one kind become one line with a count.

    Args:
        lines: where they go when it is closed.
    """

    def __init__(self, lines: list[str]) -> None:
        self._lines, self._groups = lines, {}

    def attempt(self, group: str, call: Callable[[], Any]) -> Any:
        """The call's result, or None after noting its error."""
        try:
            return call()
        except DataError as error:
            self.note(group, str(error))
            return None

    def note(self, group: str, line: str) -> None:
        """Adds a line to those of its kind."""
        self._groups.setdefault(group, []).append(line)

    def close(self) -> None:
        """Writes one line for each kind, and for kinds that expect the same one together."""
        alike: dict[str, dict[str, list[str]]] = {}
        for group, lines in self._groups.items():
            # One cause is often found in every camera: what expects the same is told once.
            same = re.search(r"(?:(?<=: )\w+: )?(?:expected|unknown key) .*?(?=, found |; |$)", lines[0])
            alike.setdefault(same[0] if same else group, {})[group] = lines
        for groups in alike.values():
            lines = [line for lines in groups.values() for line in lines]
            where = f", in {', '.join(group.split()[-1] for group in groups)}" if len(groups) > 1 else ""
            more = f" (and {len(lines) - 1} more like it{where})" if len(lines) > 1 else ""
            self._lines.append(lines[0] + more)
