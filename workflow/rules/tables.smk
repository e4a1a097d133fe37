"""Tables and the report.

REQUIRED INPUTS: results/{run}/eval/**, results/{run}/speed/**, config/tables.yaml, config/reported.csv
OUTPUTS: results/{run}/results.csv, results/{run}/tables/{table}.{csv,md,tex,html}, results/{run}/report/index.html
"""


# Every number of the run, image by image; nbavatar/reporting/results.py tells its columns and how a notebook opens it.
rule collect:
    input:
        evals=files(rules.evaluate.output.record, PLAN.rows),
        speeds=sorted(files(rules.speed.output, units.timed(PLAN))),
    output:
        "results/{run}/results.csv",
    log:
        "logs/{run}/collect.log",
    benchmark:
        "benchmarks/{run}/collect.jsonl"
    resources:
        mem="4GB",
        runtime="10m",
    params:
        code=code_digest("collect"),
    shell:
        "nbavatar collect --run {wildcards.run:q} --evals {input.evals:q} --speeds {input.speeds:q} --out {output:q}"
        " > {log:q} 2>&1"


# A table asks for the results of its own rows only: an edit of one variant rebuilds the tables that show it.
rule table:
    input:
        layout=RUN.tables,
        reported=RUN.reported,
        evals=lambda w: files(
            rules.evaluate.output.record, units.rows_of_table(PLAN, w.table)
        ),
        speeds=lambda w: files(rules.speed.output, units.timed_in_table(PLAN, w.table)),
    output:
        csv="results/{run}/tables/{table}.csv",
        md="results/{run}/tables/{table}.md",
        tex="results/{run}/tables/{table}.tex",
        html=report(
            "results/{run}/tables/{table}.html",
            category="Tables",
            labels={"table": "{table}"},
            caption="../report/table.rst",
        ),
    log:
        "logs/{run}/table/{table}.log",
    benchmark:
        "benchmarks/{run}/table/{table}.jsonl"
    resources:
        mem="2GB",
        runtime="10m",
    params:
        stem=lambda w, output: output.csv[:-4],
        given=given_digest([RUN.tables, RUN.reported]),
        label=RUN.size_label,
        cfg=options("table"),
        code=code_digest("table"),
    shell:
        "nbavatar table --table {wildcards.table:q} --layout {input.layout:q} --reported {input.reported:q}"
        " --evals {input.evals:q} --speeds {input.speeds:q} --out-stem {params.stem:q} --size-label={params.label:q}"
        " --cfg {params.cfg:q} > {log:q} 2>&1"


rule report:
    input:
        tables=files(
            [rules.table.output.md, rules.table.output.csv], units.tables(PLAN)
        ),
        contact=(
            files(rules.deform.output.table, units.people(PLAN))
            if PLAN.solves_contact
            else []
        ),
        evals=files(rules.evaluate.output.record, PLAN.rows),
        speeds=sorted(files(rules.speed.output, units.timed(PLAN))),
        renders=files(rules.render.output, PLAN.rows),
        frames=sorted(files(rules.crop.output, units.judged_crops(PLAN))),
        histories=files(rules.train.output.history, units.avatars(PLAN)),
        pictures=[
            *files(rules.figure.output.png, units.figures(PLAN)),
            *looked_at(units.people(PLAN)),
            *(
                []
                if PLAN.captured
                else files(rules.fit.output.sheet, units.people(PLAN))
            ),
            *(
                files(rules.shell.output.picture, units.people(PLAN))
                if PLAN.shelled
                else []
            ),
            *(
                files(rules.light.output.picture, units.people(PLAN))
                if PLAN.lit
                else []
            ),
            *files(rules.spectral.output.picture, units.people(PLAN)),
            *(
                files(rules.deform.output.picture, units.people(PLAN))
                if PLAN.solves_contact
                else []
            ),
        ],
        videos=files(rules.video.output.video, units.videos(PLAN)),
        tradeoffs=sweeps(RUN.tradeoff.variants, RUN.tradeoff.also),
        extremes=expand(
            rules.extremes.output.record, run=[RUN.run] if RUN.extremes else []
        ),
    output:
        report(
            "results/{run}/report/index.html",
            category="Report",
            labels={"page": "everything on one page"},
            caption="../report/page.rst",
        ),
    log:
        "logs/{run}/report.log",
    benchmark:
        "benchmarks/{run}/report.jsonl"
    resources:
        mem="8GB",
        runtime="30m",
    params:
        label=RUN.size_label,
        cfg=options("report"),
        code=code_digest("report"),
    shell:
        "nbavatar report --tables {input.tables:q} {input.contact:q} --evals {input.evals:q} --renders {input.renders:q}"
        " --speeds {input.speeds:q} --frames {input.frames:q} --histories {input.histories:q}"
        " --pictures {input.pictures:q} --videos {input.videos:q} --tradeoffs {input.tradeoffs:q}"
        " --extremes {input.extremes:q} --size-label={params.label:q}"
        " --out {output:q} --cfg {params.cfg:q} > {log:q} 2>&1"


if PLAN.compares:

    # Figures of all avatars of a comparison. By hand, `nbavatar compare` draws what there is so far.
    rule compare:
        input:
            files(rules.evaluate.output.record, PLAN.rows),
        output:
            expand("results/{run}/compare/compare.{s}", run=RUN.run, s=("md", "csv")),
            files("results/{run}/compare/{subject}_{protocol}.png", units.judged(PLAN)),
        log:
            "logs/{run}/compare.log".format(run=RUN.run),
        benchmark:
            "benchmarks/{run}/compare.jsonl".format(run=RUN.run)
        resources:
            mem="2GB",
            runtime="10m",
        params:
            folder=f"results/{RUN.run}/compare",
            cfg=parameters.comparison_text(PLAN),
            code=code_digest("compare"),
        shell:
            "nbavatar compare --evals {input:q} --out {params.folder:q} --cfg {params.cfg:q} > {log:q} 2>&1"
