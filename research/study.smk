# The studies need no campaign: `snakemake --snakefile research/study.smk --cores 2 paper stability`.
from apertura.common.provenance import code_sha256
from apertura_research.error_atlas.causes import CAUSES
from apertura_research.study.commands import PAPER_FIGURES, PAPER_PARTS, PAPER_READS
from apertura_research.study.refinement.outcomes import KINDS
from apertura_research.study.stability.sweeps import CHOICES, SWEEPS

CAMPAIGN = "results/study/paper/campaigns/{experiment}"


wildcard_constraints:
    part="|".join(PAPER_PARTS),
    figure="|".join(PAPER_FIGURES),
    experiment="lab|static|uav",
    impairment="|".join(SWEEPS),
    method="|".join(CHOICES),
    cause="|".join(CAUSES),
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
        "results/study/stability/summary.csv",
        expand("results/study/stability/{impairment}.png", impairment=SWEEPS),
        "results/study/atlas/summary.csv",
        expand("results/study/atlas/{cause}.png", cause=CAUSES),
        "results/study/refinement/losses.png",
        expand("results/study/refinement/{scene}.png", scene=KINDS),


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
        code=code_sha256("apertura.simulation.presets", "apertura.pipeline.steps.echo", "apertura.pipeline.steps.cube"),
    message:
        "the paper's experiment {wildcards.experiment}, through the ordinary pipeline"
    shell:
        "(rm -rf {params.folder} && apertura simulate {params.folder} --preset paper-{wildcards.experiment}"
        " && apertura run {params.folder} --cores {threads} && touch {output}) > {log} 2>&1"


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
        code=lambda wildcards: code_sha256("apertura_research.study.paper." + PAPER_PARTS[wildcards.part].split(":")[0]),
    message:
        "claims of the paper: {wildcards.part}"
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
        code=code_sha256("apertura_research.study.paper.claims"),
    message:
        "putting the claims together"
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
        code=code_sha256("apertura_research.study.paper.figures", "apertura_research.study.paper.experiment_figures"),
    message:
        "drawing the paper's figure {wildcards.figure}"
    shell:
        "apertura study paper-figure {wildcards.figure} > {log} 2>&1"


rule stability_sweep:
    output:
        "results/study/stability/parts/{impairment}.{method}.csv",
    log:
        "results/logs/study/{impairment}.{method}.log",
    benchmark:
        "results/benchmarks/study/{impairment}.{method}.tsv"
    conda:
        "../environment.yml"
    threads: 1
    resources:
        mem_mb=lambda wildcards, attempt: 1500 * attempt,
    params:
        code=code_sha256("apertura_research.study.stability.outcomes"),
    message:
        "sweeping {wildcards.impairment} under {wildcards.method}"
    shell:
        "apertura study stability-sweep {wildcards.impairment} {wildcards.method} > {log} 2>&1"


rule stability_chart:
    input:
        expand("results/study/stability/parts/{{impairment}}.{method}.csv", method=CHOICES),
    output:
        "results/study/stability/{impairment}.csv",
        "results/study/stability/{impairment}.png",
    log:
        "results/logs/study/{impairment}.chart.log",
    benchmark:
        "results/benchmarks/study/{impairment}.chart.tsv"
    conda:
        "../environment.yml"
    threads: 1
    resources:
        mem_mb=lambda wildcards, attempt: 500 * attempt,
    params:
        code=code_sha256("apertura_research.study.stability.charts"),
    message:
        "charting {wildcards.impairment}"
    shell:
        "apertura study stability-chart {wildcards.impairment} > {log} 2>&1"


rule stability_summary:
    input:
        expand("results/study/stability/{impairment}.csv", impairment=SWEEPS),
    output:
        "results/study/stability/summary.csv",
        "results/study/stability/summary.png",
        "results/study/stability/sidelink.csv",
        "results/study/stability/sidelink_methods.csv",
    log:
        "results/logs/study/summary.log",
    benchmark:
        "results/benchmarks/study/summary.tsv"
    conda:
        "../environment.yml"
    threads: 1
    resources:
        mem_mb=lambda wildcards, attempt: 500 * attempt,
    params:
        code=code_sha256("apertura_research.study.stability.charts"),
    message:
        "where each correction fails"
    shell:
        "apertura study stability-summary > {log} 2>&1"


rule atlas_sweep:
    output:
        "results/study/atlas/parts/{cause}.csv",
    log:
        "results/logs/study/atlas.{cause}.log",
    benchmark:
        "results/benchmarks/study/atlas.{cause}.tsv"
    conda:
        "../environment.yml"
    threads: 1
    resources:
        mem_mb=lambda wildcards, attempt: 1500 * attempt,
    params:
        code=code_sha256("apertura_research.error_atlas.outcomes"),
    message:
        "spoiling images by {wildcards.cause}"
    shell:
        "apertura study atlas-sweep {wildcards.cause} > {log} 2>&1"


rule atlas_chart:
    input:
        "results/study/atlas/parts/{cause}.csv",
    output:
        "results/study/atlas/{cause}.png",
    log:
        "results/logs/study/atlas.{cause}.chart.log",
    benchmark:
        "results/benchmarks/study/atlas.{cause}.chart.tsv"
    conda:
        "../environment.yml"
    threads: 1
    resources:
        mem_mb=lambda wildcards, attempt: 500 * attempt,
    params:
        code=code_sha256("apertura_research.error_atlas.charts"),
    message:
        "charting what {wildcards.cause} does"
    shell:
        "apertura study atlas-chart {wildcards.cause} > {log} 2>&1"


rule atlas_summary:
    input:
        expand("results/study/atlas/parts/{cause}.csv", cause=CAUSES),
    output:
        "results/study/atlas/summary.csv",
        "results/study/atlas/summary.png",
        "results/study/atlas/flags.csv",
    log:
        "results/logs/study/atlas.summary.log",
    benchmark:
        "results/benchmarks/study/atlas.summary.tsv"
    conda:
        "../environment.yml"
    threads: 1
    resources:
        mem_mb=lambda wildcards, attempt: 500 * attempt,
    params:
        code=code_sha256("apertura_research.error_atlas.charts"),
    message:
        "which mistakes are seen"
    shell:
        "apertura study atlas-summary > {log} 2>&1"


rule refinement_sweep:
    output:
        "results/study/refinement/parts/{scene}.csv",
    log:
        "results/logs/study/refinement.{scene}.log",
    benchmark:
        "results/benchmarks/study/refinement.{scene}.tsv"
    conda:
        "../environment.yml"
    threads: 1
    resources:
        mem_mb=lambda wildcards, attempt: 1500 * attempt,
    params:
        code=code_sha256("apertura_research.study.refinement.outcomes"),
    message:
        "refining tracks over {wildcards.scene}"
    shell:
        "apertura study refinement-sweep {wildcards.scene} > {log} 2>&1"


rule refinement_chart:
    input:
        expand("results/study/refinement/parts/{scene}.csv", scene=KINDS),
    output:
        "results/study/refinement/losses.csv",
        "results/study/refinement/losses.png",
    log:
        "results/logs/study/refinement.chart.log",
    benchmark:
        "results/benchmarks/study/refinement.chart.tsv"
    conda:
        "../environment.yml"
    threads: 1
    resources:
        mem_mb=lambda wildcards, attempt: 500 * attempt,
    params:
        code=code_sha256("apertura_research.study.refinement.charts"),
    message:
        "charting what refinement leaves"
    shell:
        "apertura study refinement-chart > {log} 2>&1"


rule refinement_picture:
    output:
        "results/study/refinement/{scene}.png",
    log:
        "results/logs/study/refinement.{scene}.png.log",
    benchmark:
        "results/benchmarks/study/refinement.{scene}.png.tsv"
    conda:
        "../environment.yml"
    threads: 1
    resources:
        mem_mb=lambda wildcards, attempt: 1500 * attempt,
    params:
        code=code_sha256("apertura_research.study.refinement.pictures"),
    message:
        "images of {wildcards.scene} before and after"
    shell:
        "apertura study refinement-picture {wildcards.scene} > {log} 2>&1"
