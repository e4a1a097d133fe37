"""What a job is told, and the digest of the code behind it: texts that reach it in `params`, and trigger re-runs."""

import json

from nbavatar.config.core import to_mapping
from nbavatar.config.inputs import given_digest
from nbavatar.config.run import stage_options
from nbavatar.planning.figures import shown
from nbavatar.planning.run import Plan
from nbavatar.planning.units import start_of
from nbavatar.provenance import code_digest

__all__ = [
    "avatar_code",
    "comparison_text",
    "crop_text",
    "figure_code",
    "method_of",
    "protocol_text",
    "stage_text",
    "start_digest",
    "takes_light",
]


def stage_text(plan: Plan, stage: str, variant: str | None = None) -> str:
    """The resolved options of a stage, as sorted JSON: spelling out a default changes nothing."""
    return json.dumps(stage_options(plan.run, stage, variant), sort_keys=True)


def start_digest(plan: Plan, subject: str, variant: str) -> str:
    """Digest of the file that the user gave for a training to start from; empty where there is none."""
    start = start_of(plan, subject, variant)
    return given_digest([start]) if start and isinstance(start, str) else ""


def crop_text(plan: Plan, crop: str) -> str:
    """The same of a crop."""
    return json.dumps(to_mapping(plan.run.crops[crop]), sort_keys=True)


def protocol_text(plan: Plan, protocol: str) -> str:
    """The same of a protocol, with its name."""
    return json.dumps(to_mapping(plan.run.protocols[protocol]) | {"name": protocol}, sort_keys=True)


def comparison_text(plan: Plan) -> str:
    """The same of a comparison."""
    return json.dumps(to_mapping(plan.run.compare), sort_keys=True)


def method_of(plan: Plan, variant: str) -> str:
    """Name of the method that a variant trains."""
    return stage_options(plan.run, "train", variant)["method"]


def takes_light(plan: Plan, variant: str) -> bool:
    """Whether the training of a variant is given the light of the studio."""
    if not plan.lit:
        return False
    train = stage_options(plan.run, "train", variant)
    own = train.get(train["method"], {})
    return bool(own.get("shading") and own.get("deferred"))


def avatar_code(plan: Plan, verb: str, variant: str) -> str:
    """Digest of the code behind a verb that meets an avatar: of what the method of its variant can reach."""
    return code_digest(verb, (method_of(plan, variant),))


def figure_code(plan: Plan, figure: str) -> str:
    """Digest of the code behind a figure: of what the methods of the avatars in it can reach."""
    methods = (method_of(plan, plan.figures[figure].variant),) if shown(plan, figure).models else ()
    return code_digest("figure", methods)
