"""Tables and the report.

REQUIRED INPUTS: results/{run}/eval/**, results/{run}/speed/**, config/tables.yaml, config/reported.csv
OUTPUTS: results/{run}/results.csv, results/{run}/tables/{table}.{csv,md,tex,html}, results/{run}/report/index.html
"""


# Every number of the run, image by image; nbavatar/reporting/results.py tells its columns and how a notebook opens it.
rule collect:
    input:
        evals=evals_of(ROWS),
        speeds=sorted({path for table in TABLES for path in speeds_of(table)}),
    output:
        "results/{run}/results.csv",
    log:
        "logs/{run}/collect.log",
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
        evals=lambda w: evals_of(rows_of(w.table)),
        speeds=lambda w: speeds_of(w.table),
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
    resources:
        mem="2GB",
        runtime="10m",
    params:
        stem=lambda w, output: output.csv[:-4],
        given=given([RUN.tables, RUN.reported]),
        label=RUN.size_label,
        cfg=options("table"),
        code=code_digest("table"),
    shell:
        "nbavatar table --table {wildcards.table:q} --layout {input.layout:q} --reported {input.reported:q}"
        " --evals {input.evals:q} --speeds {input.speeds:q} --out-stem {params.stem:q} --size-label={params.label:q}"
        " --cfg {params.cfg:q} > {log:q} 2>&1"


rule report:
    input:
        tables=[
            f"{R}/tables/{table}.{suffix}"
            for table in TABLES
            for suffix in ("md", "csv")
        ],
        contact=contact_tables(),
        evals=evals_of(ROWS),
        speeds=sorted({path for table in TABLES for path in speeds_of(table)}),
        renders=renders_of(ROWS),
        frames=sorted({path for row in ROWS for path in protocol_frames(row)}),
        histories=[f"{R}/train/{s}/{v}/history.jsonl" for s, v in avatars()],
        pictures=report_pictures(),
        videos=videos(),
        tradeoffs=TRADEOFFS,
        extremes=[f"{R}/extremes/record.json"] if RUN.extremes else [],
    output:
        report(
            "results/{run}/report/index.html",
            category="Report",
            labels={"page": "everything on one page"},
            caption="../report/page.rst",
        ),
    log:
        "logs/{run}/report.log",
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


if COMPARED:

    # Figures of all avatars of a comparison. By hand, `nbavatar compare` draws what there is so far.
    rule compare:
        input:
            evals_of(ROWS),
        output:
            COMPARISON,
        log:
            "logs/{run}/compare.log".format(run=RUN.run),
        resources:
            mem="2GB",
            runtime="10m",
        params:
            folder=f"{R}/compare",
            cfg=json.dumps(to_mapping(RUN.compare), sort_keys=True),
            code=code_digest("compare"),
        shell:
            "nbavatar compare --evals {input:q} --out {params.folder:q} --cfg {params.cfg:q} > {log:q} 2>&1"
