"""Commands in the documents: each is run, or it is said why not; all name options that exist."""

import argparse
import importlib
import re
import shlex

import pytest

from nbavatar.cli import VERBS
from tests.architecture.documented import COMMANDS, ELSEWHERE, PAGES, ROOT, TABLES, commands_of, known

# Reads like a command, and is none.
OTHER = {"avatar": "the kind of file, in the metadata of exported tensors"}
# Numbers that the reader has to fill in.
PLACEHOLDERS = {"M": "1.0"}


@pytest.mark.parametrize(("page", "command"), COMMANDS, ids=[f"{p.name}: {c[:60]}" for p, c in COMMANDS])
def test_a_command_is_run_somewhere_or_it_is_said_why_not(page, command):
    start = known(command)
    assert start, "name it in a table of documented.py: how it is run, or why not"
    if start in ELSEWHERE:
        file, words = ELSEWHERE[start]
        assert words in (ROOT / file).read_text(encoding="utf-8"), f"{file} no longer runs `{start}`"


def test_the_tables_hold_no_command_that_is_gone():
    starts = [start for table in TABLES for start in table]
    assert len(starts) == len(set(starts))
    assert set(starts) == {known(command) for _, command in COMMANDS}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_stand_in_blocks_of_shell(page):
    """Elsewhere, in a block without a language or in an indented one, they would be seen by no test."""
    text = page.read_text(encoding="utf-8")
    others = [block for language, block in re.findall(r"^```(\w*)\n(.*?)^```", text, re.M | re.S) if language != "sh"]
    others += re.findall(r"^ {4}(.*)", re.sub(r"^```.*?^```", "", text, flags=re.M | re.S), re.M)
    commands = [
        line for block in others for line in re.findall(r"^(?:\.venv/bin/)?(?:nbavatar|snakemake|make) .*", block, re.M)
    ]
    assert not commands


def parser_of(verb: str) -> argparse.ArgumentParser:
    module = importlib.import_module(f"nbavatar.cli.{verb.replace('-', '_')}")
    parser = argparse.ArgumentParser(exit_on_error=False)
    module.add_arguments(parser)
    return parser


def options_of(parser: argparse.ArgumentParser) -> set[str]:
    """Options of a parser and of those below it."""
    found = {"--help", "-h"}
    for action in parser._actions:
        found.update(action.option_strings)
        for below in (action.choices or {}).values() if isinstance(action, argparse._SubParsersAction) else ():
            found |= options_of(below)
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_verbs_and_options_that_a_page_names_exist(page):
    text = page.read_text(encoding="utf-8")
    named = re.findall(r"`nbavatar ([^`\n]+)`", text)
    named += [command.removeprefix("nbavatar ") for command in commands_of(page) if command.startswith("nbavatar ")]
    for words in named:
        verb, *rest = words.partition(" -- ")[0].split()
        if verb.startswith(("-", "<", "...")) or words in OTHER:
            continue
        assert verb in VERBS, words
        parser = parser_of(verb)
        if verb == "bench" and rest:  # each kernel has options of its own
            parser.add_argument("--json")
            importlib.import_module(f"nbavatar.studies.benchmarks.{rest[0]}").add_arguments(parser)
        assert {word.partition("=")[0] for word in rest if word.startswith("--")} <= options_of(parser), words


@pytest.mark.parametrize(
    "command", sorted({c for _, c in COMMANDS if c.startswith("nbavatar ")} - {"nbavatar --help"}), ids=lambda c: c[:60]
)
def test_the_command_line_takes_a_command_as_it_stands(command):
    words = [PLACEHOLDERS.get(word, word) for word in shlex.split(command)[1:]]
    if "--help" not in words:
        parser_of(words[0]).parse_args(words[1:])  # raises where argparse would end the program
