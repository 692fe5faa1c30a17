# Workflow of the studies; no campaign folder is needed:
# `snakemake --snakefile research/study.smk --cores 2 paper stability`.
from apertura.common.provenance import code_sha256
from apertura_research.autofocus.outcomes import KINDS
from apertura_research.commands import (
    PAPER_FIGURES,
    PAPER_PARTS,
    PAPER_READS,
    STUDIES,
    study_of,
)

CAMPAIGN = "results/study/paper/campaigns/{experiment}"
STUDY = {name: study_of(name) for name in STUDIES}
STEPS = ("ingest f01 uav1", "ingest f01 uav2", "echo f01 uav1-uav1", "echo f01 uav1-uav2")
# A stationary radar has no image: only the steps up to the echo are run.
STATIONARY = " && ".join(f"apertura step {step}" for step in STEPS)
PROCESSED = {"lab": STATIONARY, "static": STATIONARY, "uav": "apertura run . --cores 1"}


def parts(study, names):
    return expand("results/study/{study}/parts/{part}.csv", study=study, part=names)


wildcard_constraints:
    part="|".join([*PAPER_PARTS, *(part for study in STUDY.values() for part in study.parts)]),
    figure="|".join(PAPER_FIGURES),
    experiment="lab|static|uav",
    study="|".join(STUDY),
    chart="|".join(chart for study in STUDY.values() for chart in study.charts),
    scene="|".join(KINDS),


localrules:
    paper,
    stability,


rule paper:
    input:
        "results/study/paper/claims.csv",
        expand("results/study/paper/{figure}.png", figure=PAPER_FIGURES),


rule stability:
    input:
        [f"results/study/{name}/{chart}.png" for name, study in STUDY.items() for chart in study.charts],
        [f"results/study/{name}/{table}" for name, study in STUDY.items() for table in study.summaries],
        expand("results/study/autofocus/{scene}.png", scene=KINDS),


rule paper_campaign:
    output:
        f"{CAMPAIGN}.done",
    log:
        "results/logs/study/paper.{experiment}.log",
    benchmark:
        "results/benchmarks/study/paper.{experiment}.tsv"
    conda:
        "../environment.yml"
    threads: 1
    resources:
        mem_mb=lambda wildcards, attempt: 3000 * attempt,
    params:
        folder=CAMPAIGN,
        processed=lambda wildcards: PROCESSED[wildcards.experiment],
        code=code_sha256(
            "apertura.simulation.presets",
            "apertura.stages.echo",
            "apertura.stages.cube",
        ),
    message:
        "processing the paper's experiment {wildcards.experiment} with the regular steps"
    shell:
        "(rm -rf {params.folder} && apertura simulate {params.folder} --preset paper-{wildcards.experiment}"
        " && (cd {params.folder} && {params.processed}) && touch {output}) > {log} 2>&1"


rule paper_part:
    input:
        lambda wildcards: expand(f"{CAMPAIGN}.done", experiment=PAPER_READS.get(wildcards.part, ())),
    output:
        "results/study/paper/parts/{part}.csv",
    log:
        "results/logs/study/paper.{part}.log",
    benchmark:
        "results/benchmarks/study/paper.{part}.tsv"
    conda:
        "../environment.yml"
    threads: 1
    resources:
        mem_mb=lambda wildcards, attempt: 1500 * attempt,
    params:
        code=lambda wildcards: code_sha256("apertura_research.paper." + PAPER_PARTS[wildcards.part].split(":")[0]),
    message:
        "computing claims of the paper: {wildcards.part}"
    shell:
        "apertura study paper-part {wildcards.part} > {log} 2>&1"


rule paper_claims:
    input:
        expand("results/study/paper/parts/{part}.csv", part=PAPER_PARTS),
    output:
        "results/study/paper/claims.csv",
    log:
        "results/logs/study/paper.claims.log",
    benchmark:
        "results/benchmarks/study/paper.claims.tsv"
    conda:
        "../environment.yml"
    threads: 1
    resources:
        mem_mb=lambda wildcards, attempt: 500 * attempt,
    params:
        code=code_sha256("apertura_research.paper.claims"),
    message:
        "merging the claims"
    shell:
        "apertura study paper-claims > {log} 2>&1"


rule paper_figure:
    input:
        lambda wildcards: expand(f"{CAMPAIGN}.done", experiment=PAPER_FIGURES[wildcards.figure]),
    output:
        "results/study/paper/{figure}.png",
    log:
        "results/logs/study/paper.{figure}.png.log",
    benchmark:
        "results/benchmarks/study/paper.{figure}.png.tsv"
    conda:
        "../environment.yml"
    threads: 1
    resources:
        mem_mb=lambda wildcards, attempt: 1500 * attempt,
    params:
        code=code_sha256("apertura_research.paper.figures", "apertura_research.paper.figures"),
    message:
        "drawing the paper's figure {wildcards.figure}"
    shell:
        "apertura study paper-figure {wildcards.figure} > {log} 2>&1"


rule sweep:
    output:
        "results/study/{study}/parts/{part}.csv",
    log:
        "results/logs/study/{study}.{part}.log",
    benchmark:
        "results/benchmarks/study/{study}.{part}.tsv"
    conda:
        "../environment.yml"
    threads: 1
    resources:
        mem_mb=lambda wildcards, attempt: 1500 * attempt,
    params:
        code=lambda wildcards: code_sha256(STUDY[wildcards.study].run.__module__),
    message:
        "{wildcards.study}: computing {wildcards.part}"
    shell:
        "apertura study sweep {wildcards.study} {wildcards.part} > {log} 2>&1"


rule chart:
    input:
        lambda wildcards: parts(wildcards.study, STUDY[wildcards.study].charts[wildcards.chart]),
    output:
        "results/study/{study}/{chart}.csv",
        "results/study/{study}/{chart}.png",
    log:
        "results/logs/study/{study}.{chart}.chart.log",
    benchmark:
        "results/benchmarks/study/{study}.{chart}.chart.tsv"
    conda:
        "../environment.yml"
    threads: 1
    resources:
        mem_mb=lambda wildcards, attempt: 500 * attempt,
    params:
        code=lambda wildcards: code_sha256(STUDY[wildcards.study].draw.__module__),
    message:
        "{wildcards.study}: drawing chart {wildcards.chart}"
    shell:
        "apertura study chart {wildcards.study} {wildcards.chart} > {log} 2>&1"


for study_name, study in STUDY.items():
    if study.summaries:

        rule:
            name:
                f"{study_name}_summary"
            input:
                parts(study_name, study.parts),
            output:
                expand(
                    "results/study/{study}/{table}",
                    study=study_name,
                    table=study.summaries,
                ),
            log:
                f"results/logs/study/{study_name}.summary.log",
            benchmark:
                f"results/benchmarks/study/{study_name}.summary.tsv"
            conda:
                "../environment.yml"
            threads: 1
            resources:
                mem_mb=lambda wildcards, attempt: 500 * attempt,
            params:
                study=study_name,
                code=code_sha256(study.draw.__module__),
            message:
                "{params.study}: writing summary tables and plot"
            shell:
                "apertura study summary {params.study} > {log} 2>&1"


rule autofocus_picture:
    output:
        "results/study/autofocus/{scene}.png",
    log:
        "results/logs/study/autofocus.{scene}.png.log",
    benchmark:
        "results/benchmarks/study/autofocus.{scene}.png.tsv"
    conda:
        "../environment.yml"
    threads: 1
    resources:
        mem_mb=lambda wildcards, attempt: 1500 * attempt,
    params:
        code=code_sha256("apertura_research.autofocus.charts"),
    message:
        "drawing images of {wildcards.scene} before and after autofocus"
    shell:
        "apertura study autofocus-picture {wildcards.scene} > {log} 2>&1"
