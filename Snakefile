# The only entry: `snakemake` plans and runs what config/paper.yaml (or --configfile) describes.
# What depends on what is in workflow/rules; what is computed is in the Python package.

import importlib.util

from snakemake.exceptions import WorkflowError
from snakemake.utils import min_version

min_version("9.20")

if importlib.util.find_spec("nbavatar") is None:
    raise WorkflowError(
        "the Python package nbavatar is not installed beside this snakemake; run `make install` and use "
        '.venv/bin/snakemake, or: python -m pip install "nbavatar[pipeline]"'
    )

# A configuration given on the command line replaces the paper's as a whole; nothing is merged under it.
if "run" not in config:

    configfile: "config/paper.yaml"


report: "workflow/report/workflow.rst"


container: "docker://ghcr.io/nbavatar/nbavatar:0.2.0"


include: "workflow/rules/common.smk"
include: "workflow/rules/ingest.smk"
include: "workflow/rules/masks.smk"
include: "workflow/rules/geometry.smk"
include: "workflow/rules/train.smk"
include: "workflow/rules/evaluate.smk"
include: "workflow/rules/figures.smk"
include: "workflow/rules/tradeoff.smk"
include: "workflow/rules/tables.smk"
include: "workflow/rules/targets.smk"


# What `snakemake` without a target makes. It comes last, because it names outputs of the other rules, and stands in this
# file, because Snakemake takes no default target from an included one.
rule all:
    default_target: True
    input:
        (
            rules.compare.output
            if PLAN.compares
            else [
                *files(rules.video.output.video, units.videos(PLAN)),
                *sweeps(RUN.tradeoff.variants, RUN.tradeoff.also),
                *expand(
                    rules.extremes.output.table, run=[RUN.run] if RUN.extremes else []
                ),
                *files(rules.figure.output.png, units.figures(PLAN)),
                *files(rules.evaluate.output.record, PLAN.rows),
                *expand(rules.collect.output, run=RUN.run),
                *files(TABLES, units.tables(PLAN)),
                *expand(rules.report.output, run=RUN.run),
            ]
        ),
