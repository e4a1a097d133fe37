"""The plan of the run, and what rules ask of it. What it says is in nbavatar/planning; nothing imports torch."""

import shlex
import shutil
import sys
from pathlib import Path

from snakemake.exceptions import WorkflowError

from nbavatar.config.inputs import given_digest
from nbavatar.errors import NBAvatarError
from nbavatar.planning import layouts, parameters, units
from nbavatar.planning.figures import shown
from nbavatar.planning.paths import constraints, fill
from nbavatar.planning.run import read_plan
from nbavatar.provenance import code_digest

try:
    PLAN = read_plan(config)
except NBAvatarError as error:
    raise WorkflowError(str(error)) from None
RUN = PLAN.run

# `.venv/bin/snakemake` works without activating its environment, also where another one is active: its commands are
# then found beside it.
BESIDE = Path(sys.executable).parent
if shutil.which("snakemake") != str(BESIDE / "snakemake"):
    shell.prefix(f'export PATH={shlex.quote(str(BESIDE))}:"$PATH"; ')


wildcard_constraints:
    **constraints(PLAN),


def files(patterns, of):
    """Outputs of a rule for some units of work."""
    return fill(patterns, of, run=RUN.run)


def mesh_file(meshes):
    """Meshes as a stage leaves them: its first output."""
    return files(getattr(rules, meshes.stage).output[0], [meshes])[0]


def meshes_of(wildcards):
    """The meshes that carry a variant."""
    return mesh_file(units.meshes_of(PLAN, wildcards.subject, wildcards.variant))


def train_frames(wildcards):
    """Crops that a variant is trained on."""
    return files(
        rules.crop.output, units.trained_on(PLAN, wildcards.subject, wildcards.variant)
    )


def start_of(wildcards):
    """The model that a training starts from, if any."""
    start = units.start_of(PLAN, wildcards.subject, wildcards.variant)
    if isinstance(start, units.Avatar):
        return files(rules.train.output.model, [start])
    return [start] if start else []


def light_of(wildcards):
    """The studio's light, where the method of a variant can use it."""
    lit = parameters.takes_light(PLAN, wildcards.variant)
    return (
        files(rules.light.output.lights, [units.Person(wildcards.subject)])
        if lit
        else []
    )


def judged_frames(subject, protocol):
    """Crops that a protocol looks at."""
    try:
        return files(rules.crop.output, units.judged_on(PLAN, subject, protocol))
    except NBAvatarError as error:
        raise WorkflowError(str(error)) from None


def checked(wildcards):
    """What has to be there, however old, before anything is made of a capture."""
    people = [units.Person(wildcards.subject)]
    return ancient(files(rules.check.output.record, people)) if PLAN.captured else []


def options(stage):
    """The resolved options of a stage."""
    return lambda w: parameters.stage_text(PLAN, stage, w.get("variant"))


def code_of(verb):
    """Digest of the code behind a verb that meets an avatar."""
    return lambda w: parameters.avatar_code(PLAN, verb, w.variant)


def looked_at(people):
    """Pictures of captures that have been checked as they are now."""
    return files(rules.check_sheet.output, people) if PLAN.captured else []


def sweeps(variants, also):
    """Sweeps of some variants, and what is measured besides."""
    found = units.swept(PLAN, variants)
    savings = [rules.savings.output.result] if "savings" in also else []
    made = files([rules.tradeoff.output.result, *savings], found)
    people = dict.fromkeys(units.Person(avatar.subject) for avatar in found)
    return made + files(
        rules.offline.output.result, people if "offline" in also else []
    )
