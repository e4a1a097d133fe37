"""A comparison: which avatars it has, and what becomes of their figures."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from nbavatar.cli import main
from nbavatar.config.compare import CompareRun, compared
from nbavatar.config.run import load_run, stage_options
from nbavatar.errors import ConfigError
from nbavatar.evaluation.silhouette import silhouette_error
from nbavatar.io.images import decode_image

ROOT = Path(__file__).parents[3]


def _merged(over: dict) -> dict:
    """The shipped files of a comparison, laid over each other as snakemake does, and options over all."""
    from nbavatar.config.core import merge

    result: dict = {}
    for name in ("capture", "methods", "compare"):
        result = merge(result, yaml.safe_load((ROOT / f"config/{name}.yaml").read_text()))
    return merge(result, over)


def test_a_comparison_makes_a_variant_for_each_budget_and_seed_that_differs_in_nothing_else() -> None:
    run = load_run(_merged({"compare": {"minutes": [2, 12.5], "seeds": [0, 7]}}))
    names = [one.name for one in compared(run.compare)]
    assert len(names) == 2 * 2 * 4 and names[:4] == [
        "full-2min-seed0", "no_shell-2min-seed0", "gaussian_avatars-2min-seed0", "splatting_avatar-2min-seed0",
    ]  # fmt: skip
    base, one = stage_options(run, "train", "gaussian_avatars"), "gaussian_avatars-12.5min-seed7"
    found = stage_options(run, "train", one)
    assert found == base | {"max_minutes": 12.5, "seed": 7}
    assert not run.variants["no_shell-2min-seed7"].shell and run.variants["full-2min-seed7"].shell
    steps = load_run(_merged({"compare": {"minutes": [], "steps": [600], "seeds": [1]}}))
    found = stage_options(steps, "train", "full-600steps-seed1")
    assert (found["steps"], found["max_minutes"], found["seed"]) == (600, None, 1)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"steps": [600]}, "minutes, steps: expected budgets of one kind, found both"),
        ({"minutes": []}, "found neither"),
        ({"seeds": [1, 1]}, "seeds: expected each once"),
        ({"variants": ["ful"]}, "unknown variant 'ful'"),
        ({"protocols": ["nw"]}, "unknown protocol 'nw'"),
    ],
)
def test_comparisons_that_cannot_be_are_refused(options: dict, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        load_run(_merged({"compare": options}))


def test_figures_are_sorted_by_budget_and_seed_with_mean_and_range(tmp_path) -> None:
    cfg = {"variants": ["full", "other"], "minutes": [2, 12], "seeds": [0, 1, 2], "protocols": ["nv"]}
    avatars = compared(CompareRun(**cfg))
    files, rng = [], np.random.default_rng(0)
    for one in [*avatars, None]:
        if one is not None and (one.variant, one.budget, one.seed) == ("other", 12, 2):
            continue
        metrics = {"psnr": 20 + one.budget / 2 + one.seed + (one.variant == "other")} if one else {"psnr": 1.0}
        metrics |= {"lpips_vgg": 0.1 / one.budget if one else 0.1, "over": 0.01, "under": None}
        result = {
            "subject": "person", "variant": one.name if one else "else", "protocol": {"name": "nv"},
            "protocol_hash": "", "metrics": metrics, "per_image": [], "training": {"steps": 100},
        }  # fmt: skip
        files.append(tmp_path / f"{rng.integers(1 << 40)}.json")
        files[-1].write_text(json.dumps(result))
    out = tmp_path / "out"
    assert main(["compare", "--evals", *map(str, files), "--out", str(out), "--cfg", json.dumps(cfg)]) == 0
    text = (out / "compare.md").read_text()
    rows = {tuple(c.strip() for c in line.split("|")[1:3]): line for line in text.splitlines() if "min |" in line}
    assert list(rows) == [("2 min", "full"), ("2 min", "other"), ("12 min", "full"), ("12 min", "other")]
    assert "| 3 | 100 | 22.00 ± 1.00 |" in rows["2 min", "full"]  # 21, 22, 23
    assert "| 3 | 100 | **23.00** ± 1.00 |" in rows["2 min", "other"]
    assert "| 2 | 100 | **27.50** ± 0.50 |" in rows["12 min", "other"]  # one seed is not there yet
    assert "1 results" in text and "`person/other-12min-seed2/nv`" in text
    lines = list(csv.DictReader((out / "compare.csv").open()))
    assert len(lines) == 11 and {line["under"] for line in lines} == {""}
    assert [float(line["psnr"]) for line in lines[:3]] == [21, 22, 23]
    assert decode_image(out / "person_nv.png").std() > 5
    assert main(["compare", "--evals", str(files[-1]), "--out", str(out), "--cfg", json.dumps(cfg)]) == 2


def test_silhouette_error_tells_excess_from_lack() -> None:
    true, predicted = np.zeros((2, 4), np.uint8), np.zeros((2, 4), np.uint8)
    true[0], predicted[0, :3], predicted[1, 0] = 255, 255, 51
    assert silhouette_error(predicted, true) == pytest.approx((0.05, 0.25))
    assert silhouette_error(true, true) == (0.0, 0.0)
    assert silhouette_error(true * 0, true * 0) == (0.0, 0.0) and silhouette_error(true, true * 0)[0] == float("inf")
