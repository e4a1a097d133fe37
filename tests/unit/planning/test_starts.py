"""What trainings start from: files, avatars of the same run, and what is refused before any job."""

import pytest

from nbavatar.config.tradeoff import TradeoffConfig
from nbavatar.errors import ConfigError
from nbavatar.planning import units
from nbavatar.planning.costs import workload
from nbavatar.planning.parameters import start_digest
from nbavatar.planning.run import Plan
from tests.scenes.capture import write_capture
from tests.unit.planning.plans import shipped


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """A folder of two captures."""
    folder = tmp_path_factory.mktemp("captures")
    for name in ("ann", "ben"):
        write_capture(folder / name)
    return folder


def plan_of(root, starts: dict[str, str], **changes) -> Plan:
    """A plan whose variants start from something; `full`, the only one that the sheet asks for, among them."""
    variants = {
        name: {"crop": "full", "meshes": "fit", "stages": {"train": {"start": start}}}
        for name, start in ({"full": ""} | starts).items()
    }
    return shipped("capture", data_root=str(root), variants=variants, **changes)


def test_a_start_in_the_run_is_an_avatar_that_is_made_whether_a_row_asks_for_it_or_not(root) -> None:
    plan = plan_of(root, {"full": "ann/bare", "bare": ""})
    assert units.start_of(plan, "ben", "full") == units.start_of(plan, "ann", "full") == units.Avatar("ann", "bare")
    assert units.start_of(plan, "ann", "bare") == ""
    assert units.avatars(plan) == [units.Avatar("ann", "full"), units.Avatar("ben", "full")]
    assert units.starts(plan) == [units.Avatar("ann", "bare")]
    trained = {work.of: work.jobs for work in workload(plan, 4, TradeoffConfig()) if work.rule == "train"}
    assert trained == {"full": 2, "bare": 1}
    assert start_digest(plan, "ben", "full") == ""


def test_a_whole_run_may_start_from_one_of_its_avatars_which_starts_from_nothing(root) -> None:
    plan = plan_of(root, {"full": "ann/full"})
    assert units.start_of(plan, "ann", "full") == ""
    assert units.start_of(plan, "ben", "full") == units.Avatar("ann", "full")
    assert units.starts(plan) == [], "a row asks for it"


def test_starts_of_the_subjects_that_are_wanted_stay_known(root) -> None:
    plan = plan_of(root, {"full": "ann/bare", "bare": "ben/bald", "bald": ""}, only=["ben"])
    assert {row.subject for row in plan.rows} == {"ben"} and set(plan.subjects) == {"ann", "ben"}
    assert units.starts(plan) == [units.Avatar("ann", "bare"), units.Avatar("ben", "bald")]
    assert set(plan_of(root, {"full": "ben/bare", "bare": ""}, only=["ben"]).subjects) == {"ben"}


def test_a_file_is_an_input_of_the_user(root, tmp_path) -> None:
    path = tmp_path / "model.pt"
    path.write_bytes(b"one")
    plan = plan_of(root, {"full": str(path)})
    assert units.start_of(plan, "ann", "full") == str(path) and units.starts(plan) == []
    before = start_digest(plan, "ann", "full")
    other = tmp_path / "other.pt"
    other.write_bytes(b"two")
    assert before and start_digest(plan_of(root, {"full": str(other)}), "ann", "full") != before


@pytest.mark.parametrize("name", ["paper", "capture"])
def test_no_shipped_training_starts_from_another(root, name) -> None:
    plan = shipped(name, layout="capture", data_root=str(root)) if name != "paper" else shipped("paper")
    assert not plan.starts and all(not units.start_of(plan, row.subject, row.variant) for row in plan.rows)


@pytest.mark.parametrize(
    ("starts", "message"),
    [
        ({"full": "an/full"}, "variants.full: train.start: unknown subject 'an'; did you mean 'ann'?"),
        ({"full": "ann/fill"}, "variants.full: train.start: unknown variant 'fill'; did you mean 'full'?"),
        ({"full": "ann"}, r"train.start: expected a file \(model.pt\), or subject/variant of this run, found 'ann'"),
        (
            {"full": "a/b/c"},
            r"train.start: expected a file \(model.pt\), or subject/variant of this run, found 'a/b/c'",
        ),
        ({"full": "none/model.pt"}, r"train.start: expected a file \(model.pt\), found no such file: none/model.pt"),
        ({"full": "a{b}.pt"}, "train.start: expected a path without braces"),
        (
            {"full": "results/capture/train/ann/bare/model.pt", "bare": ""},
            "train.start: expected a file from elsewhere, .*; write subject/variant, so that it is made first",
        ),
        (
            {"full": "ann/bare", "bare": "ben/full"},
            "variants.full: train.start: expected a beginning, found a circle: ann/bare from ben/full from ann/bare",
        ),
        (
            {"full": "ann/bare", "bare": "ann/full"},
            "variants.bare: train.start: expected a beginning, found a circle: ann/full from ann/bare from ann/full",
        ),
    ],
    ids=str,
)
def test_a_start_that_cannot_be_is_refused_in_one_line(root, starts, message) -> None:
    with pytest.raises(ConfigError, match=message) as error:
        plan_of(root, starts)
    assert "\n" not in str(error.value)


def test_an_avatar_of_another_method_is_refused_before_any_job(root) -> None:
    variants = {
        "full": {"crop": "full", "meshes": "fit", "stages": {"train": {"start": "ann/gauss"}}},
        "gauss": {"crop": "full", "meshes": "fit", "stages": {"train": {"method": "gaussian_avatars"}}},
    }
    expected = "variants.full: train.start: expected an avatar of the method billboards, found one of gaussian_avatars"
    with pytest.raises(ConfigError, match=expected):
        shipped("capture", data_root=str(root), variants=variants)
