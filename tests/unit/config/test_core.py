import dataclasses
import json

import pytest

from nbavatar.config.core import from_mapping, json_schema, merge, option, to_mapping
from nbavatar.errors import ConfigError


@dataclasses.dataclass(frozen=True)
class Inner:
    rate: float = option(1e-3, "rate", min=0)
    net: str = option("alex", "net", choices=("alex", "vgg"))


@dataclasses.dataclass(frozen=True)
class Outer:
    steps: int = option(10, "steps", min=1, max=100)
    inner: Inner = option(Inner, "inner")
    shares: list[float] = option([0.1, 0.5], "shares", min=0, max=1)
    limit: int | None = option(None, "limit", min=1)
    table: dict[str, Inner] = option({}, "table")
    on: bool = option(True, "switch")


def test_from_mapping_reads_nested_values_and_keeps_defaults():
    value = from_mapping(Outer, {"inner": {"rate": 1}, "limit": 3, "table": {"a": {"net": "vgg"}}}, "cfg")
    assert value == Outer(inner=Inner(rate=1.0), limit=3, table={"a": Inner(net="vgg")})
    assert isinstance(value.inner.rate, float)


def test_to_mapping_inverts_from_mapping():
    value = from_mapping(Outer, {"table": {"a": {"rate": 2.0}}, "shares": [0.3]}, "cfg")
    assert from_mapping(Outer, json.loads(json.dumps(to_mapping(value))), "cfg") == value


@pytest.mark.parametrize("text", ["1e-3", "1E-3", "+1e-3", "1.e-3", "10e-4", "0.1e-2"])
def test_an_exponent_that_yaml_reads_as_text_is_a_number_where_one_is_meant(text):
    from nbavatar.config.yamlfiles import parse_yaml

    for value in (text, parse_yaml(f"rate: {text}", "x")["rate"]):
        assert from_mapping(Outer, {"inner": {"rate": value}}, "cfg").inner.rate == 1e-3
    for value in ({"net": "1e-3"}, {"net": "alex", "rate": "e-3"}):
        with pytest.raises(ConfigError):
            from_mapping(Outer, {"inner": value}, "cfg")


@pytest.mark.parametrize(
    ("mapping", "words"),
    [
        ({"step": 3}, ["cfg", "'step'", "did you mean 'steps'?"]),
        ({"steps": "1e3"}, ["cfg.steps", "a whole number", "'1e3'"]),
        ({"steps": 0}, ["cfg.steps", "at least 1", "0"]),
        ({"steps": 101}, ["cfg.steps", "at most 100"]),
        ({"steps": True}, ["cfg.steps", "a whole number", "True"]),
        ({"inner": {"rate": "1e-3m"}}, ["cfg.inner.rate", "a number", "'1e-3m'"]),
        ({"inner": {"rate": "0.5"}}, ["cfg.inner.rate", "a number", "'0.5'"]),
        ({"shares": ["2e1"]}, ["cfg.shares[0]", "at most 1", "20.0"]),
        ({"inner": {"rate": float("nan")}}, ["cfg.inner.rate", "NaN"]),
        ({"inner": {"net": "vggg"}}, ["cfg.inner.net", "one of alex, vgg"]),
        ({"shares": [0.1, 2.0]}, ["cfg.shares[1]", "at most 1"]),
        ({"shares": 0.1}, ["cfg.shares", "a list"]),
        ({"limit": 0}, ["cfg.limit", "at least 1"]),
        ({"table": {"a": {"nett": "x"}}}, ["cfg.table.a", "'nett'", "'net'"]),
        ({"inner": 3}, ["cfg.inner", "mapping"]),
    ],
)
def test_from_mapping_refuses_in_one_line_that_names_the_key(mapping, words):
    with pytest.raises(ConfigError) as caught:
        from_mapping(Outer, mapping, "cfg")
    message = str(caught.value)
    assert "\n" not in message
    for word in words:
        assert word in message


def test_merge_is_deep_and_leaves_its_arguments_alone():
    base = {"a": {"b": 1, "c": [1, 2]}, "d": 1}
    assert merge(base, {"a": {"c": [3]}, "e": 2}) == {"a": {"b": 1, "c": [3]}, "d": 1, "e": 2}
    assert base == {"a": {"b": 1, "c": [1, 2]}, "d": 1}


def test_json_schema_accepts_and_refuses_like_from_mapping():
    jsonschema = pytest.importorskip("jsonschema")
    schema = json_schema(Outer)
    jsonschema.Draft202012Validator.check_schema(schema)
    validator = jsonschema.Draft202012Validator(schema)
    assert validator.is_valid({"steps": 5, "inner": {"net": "vgg"}, "limit": None})
    for bad in ({"step": 3}, {"steps": 0}, {"inner": {"net": "x"}}, {"shares": [2.0]}, {"limit": "a"}):
        assert not validator.is_valid(bad)
        with pytest.raises(ConfigError):
            from_mapping(Outer, bad, "cfg")
