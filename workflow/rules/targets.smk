"""Names to ask for parts of the work: `snakemake subject_S2`, `snakemake table_ablation`, `snakemake stage_fit`."""

TABLES = [rules.table.output.csv, rules.table.output.md, rules.table.output.tex]

# Every file of one stage that the whole run needs.
STAGES = {
    "ingest": files(rules.ingest.output, units.views(PLAN)),
    "tracks": files(rules.tracks.output, units.people(PLAN)),
    "masks": files(rules.masks.output, units.views(PLAN)),
    "crop": files(rules.crop.output, units.crops(PLAN)),
    "spectral": files(rules.spectral.output.meshes, units.people(PLAN)),
    "deform": files(rules.deform.output.meshes, units.people(PLAN)),
    "train": files(rules.train.output.model, units.avatars(PLAN)),
    "render": files(rules.render.output, PLAN.rows),
    "evaluate": files(rules.evaluate.output.record, PLAN.rows),
    "speed": sorted(files(rules.speed.output, units.timed(PLAN))),
    # The whole of it, also where the run itself sweeps nothing.
    "tradeoff": sweeps(
        RUN.tradeoff.variants or list(RUN.variants)[:1], ("savings", "offline")
    ),
}
if PLAN.captured:
    STAGES["check"] = looked_at(units.people(PLAN))
else:
    STAGES["fit"] = files(rules.fit.output.meshes, units.people(PLAN))
if PLAN.shelled:
    STAGES["shell"] = files(rules.shell.output.meshes, units.people(PLAN))
if PLAN.lit:
    STAGES["light"] = files(rules.light.output.lights, units.people(PLAN))
if PLAN.aligned:
    STAGES["align"] = files(rules.align.output, units.people(PLAN))


for _subject in PLAN.subjects:

    rule:
        name:
            f"subject_{_subject}"
        input:
            files(
                rules.evaluate.output.record,
                [row for row in PLAN.rows if row.subject == _subject],
            ),
            looked_at([units.Person(_subject)]),


for _table in PLAN.tables:

    rule:
        name:
            f"table_{_table}"
        input:
            files(TABLES, [units.Table(_table)]),
            looked_at(map(units.Person, PLAN.subjects)),


for _stage in STAGES:

    rule:
        name:
            f"stage_{_stage}"
        input:
            STAGES[_stage],
            looked_at(map(units.Person, PLAN.subjects)),
