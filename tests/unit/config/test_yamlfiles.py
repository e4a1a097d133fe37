"""YAML files: read, or refused in one line that names them."""

import pytest

from nbavatar.config.yamlfiles import read_yaml
from nbavatar.errors import ConfigError


def test_a_file_of_windows_is_read(tmp_path):
    (tmp_path / "a.yaml").write_bytes("\ufeffsteps: 5\r\nname: Ärger\r\n".encode())
    assert read_yaml(tmp_path / "a.yaml", "options") == {"steps": 5, "name": "Ärger"}


@pytest.mark.parametrize(
    ("content", "match"),
    [
        (b"? \n: 5\n", "a name before every ':', found an empty key"),
        (b"a: {b: [1, {~: 2}]}\n", "an empty key"),
        (b": 5\n", "text that does not parse"),
        (b"a: &a [*a]\n", "one that holds itself"),
        (b"\xff\xfea", "text that does not parse .*utf-8"),
        (b"when: 2024-13-45\n", "text that does not parse .*month"),
        (b"a: [" * 3000, "text that does not parse .*nested too deeply"),
        (b"a: !!python/object/apply:os.system ['true']\n", "text that does not parse"),
        (b"steps: 1" + b":59" * 1000, "a number of 3001 characters"),  # to the base of 60, in quadratic time
        (b"? [a]\n: b\n", "text that does not parse .*unhashable"),
        (b"".join(b"k%d: &k%d [*k%d, *k%d]\n" % (i, i, i - 1, i - 1) if i else b"k0: &k0 [1]\n" for i in range(50)),
         "refer to one another without end"),
    ],
)  # fmt: skip
def test_what_cannot_be_used_is_one_line(tmp_path, content, match):
    (tmp_path / "a.yaml").write_bytes(content)
    with pytest.raises(ConfigError, match=rf"a\.yaml.*{match}") as caught:
        read_yaml(tmp_path / "a.yaml", "options")
    assert "\n" not in str(caught.value)
