"""`--set` beside `--cfg`, and what shells are told of the command line."""

import argparse
import subprocess

import pytest

from nbavatar.cli import VERBS, main
from nbavatar.cli.common import add_cfg_argument, stage_config
from nbavatar.cli.completion import whole_parser
from nbavatar.config.training import TrainConfig
from nbavatar.errors import ConfigError


def options(*words: str) -> TrainConfig:
    parser = argparse.ArgumentParser()
    add_cfg_argument(parser, TrainConfig)
    return stage_config(parser.parse_args(words), TrainConfig)


def test_single_options_go_over_those_of_the_mapping() -> None:
    found = options(
        "--cfg", '{"steps": 5, "billboards": {"rates": {"alpha": 0.5, "features": 0.1}}}', "--set", "steps=7",
        "--set", "billboards.rates.features=1e-3", "--set", "billboards.rates.features=2e-3", "--set", "parts=[head]",
        "--set", "billboards.deferred=false",
    )  # fmt: skip
    own = found.billboards
    assert (found.steps, own.rates.alpha, own.rates.features) == (7, 0.5, 2e-3)
    assert found.parts == ["head"] and own.deferred is False


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--set", "steps"], "--set: expected key=value or key.sub=value, found 'steps'"),
        (["--set", "billboards.=1"], "--set: expected key=value"),
        (["--set", "stepz=1"], "--set: unknown key 'stepz'; did you mean 'steps'?"),
        (["--set", "billboards=1"], "--set.billboards: expected a mapping"),
        (["--set", "steps=[1"], "--set steps: expected YAML"),
        (["--cfg", '{"steps": 5}', "--set", "steps=few"], "--cfg, --set.steps: expected a whole number, found 'few'"),
    ],
)
def test_what_is_no_option_is_one_line(words, line) -> None:
    with pytest.raises(ConfigError) as caught:
        options(*words)
    assert str(caught.value).startswith(line) and "\n" not in str(caught.value)


def test_bash_completes_verbs_options_and_choices(tmp_path, capsys) -> None:
    assert main(["completion", "bash"]) == 0
    script = tmp_path / "completion.sh"
    script.write_text(capsys.readouterr().out)

    def complete(*words: str) -> list[str]:
        ask = f'. "{script}"; COMP_WORDS=({" ".join(words)}); COMP_CWORD={len(words) - 1}; _shtab_nbavatar; '
        done = subprocess.run(["bash", "-c", ask + 'printf "%s\\n" "${COMPREPLY[@]}"'], capture_output=True, text=True)
        return done.stdout.split()

    assert complete("nbavatar", "expo") == ["export"]
    assert complete("nbavatar", "export", "--to", "s") == ["splats"]
    assert set(complete("nbavatar", "train", "--s")) == {"--set", "--spectral", "--start"}
    assert set(whole_parser()._subparsers._group_actions[0].choices) == set(VERBS)
