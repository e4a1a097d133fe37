"""Digests of what modules say: made once, kept where nobody else can write, never stale, and no error to be without."""

import ast
import hashlib

import pytest

from nbavatar import syntax


@pytest.fixture
def modules(tmp_path, monkeypatch):
    """Two modules, a place to keep digests, and a function that asks for them as a new process would."""
    for name, text in (("one", 'def f(x):\n    """Doc."""\n    return x + 1\n'), ("two", "B = 2  # two\n")):
        (tmp_path / f"{name}.py").write_text(text)
    monkeypatch.setattr(syntax, "source_of", lambda name: tmp_path / f"{name}.py")
    monkeypatch.setattr(syntax, "cache_places", lambda: [tmp_path / "cache"])

    def ask():
        syntax._place.cache_clear(), syntax._kept.cache_clear()
        return syntax.syntax_digests(["one", "two"])

    yield tmp_path, ask
    syntax._place.cache_clear(), syntax._kept.cache_clear()


def test_what_is_kept_is_not_parsed_again_and_an_edit_is(modules, monkeypatch):
    folder, ask = modules
    first, parsed = ask(), []
    parse = ast.parse
    monkeypatch.setattr(syntax.ast, "parse", lambda source: parsed.append(source) or parse(source))
    assert ask() == first and not parsed
    (folder / "one.py").write_text('def f(x):\n    """Reworded."""\n\n    return x + 1  # the next\n')
    assert ask() == first and len(parsed) == 1  # another text that says the same
    (folder / "two.py").write_text("B = 3  # two\n")
    assert ask() == {**first, "two": syntax.syntax_digest(b"B = 3")} and ask()["two"] != first["two"]
    assert len(parsed) == 3  # once for the edit, once for what it is compared with


@pytest.mark.parametrize("content", [b"\xff", b"[1]", b'{"a": 1}', b"{", b'{"%s": "short"}' % (b"0" * 64)])
def test_a_damaged_file_is_made_again(modules, content):
    folder, ask = modules
    first = ask()
    (kept,) = folder.glob("cache/syntax/*.json")
    kept.write_bytes(content)
    assert ask() == first
    assert hashlib.sha256((folder / "one.py").read_bytes()).hexdigest() in kept.read_text()


def test_without_a_place_modules_are_parsed(modules, monkeypatch):
    folder, ask = modules
    first = ask()
    (folder / "open").mkdir()
    (folder / "open" / "syntax").symlink_to(folder / "cache" / "syntax")
    for places in ([], [folder / "one.py"], [folder / "open"]):
        monkeypatch.setattr(syntax, "cache_places", lambda places=places: places)
        assert ask() == first and syntax._place() is None
