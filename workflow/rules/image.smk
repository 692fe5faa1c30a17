rule scene:
    input:
        campaign.scene_sources(),
    output:
        "results/scene.json",
    log:
        "results/logs/scene.log",
    benchmark:
        "results/benchmarks/scene.tsv"
    conda:
        "../../environment.yml"
    threads: 1
    resources:
        mem_mb=lambda wildcards, attempt: 500 * attempt,
    params:
        settings=campaign.relevant("scene"),
        code=code_sha256("apertura.steps.scene"),
    message:
        "settling the campaign's grid"
    shell:
        "apertura step scene > {log} 2>&1"


rule image:
    input:
        "results/{flight}/{pair}/echo.manifest.json",
        "results/{flight}/{pair}/profile.manifest.json",
        "results/scene.json",
    output:
        "results/{flight}/{pair}/image.manifest.json",
        "results/{flight}/{pair}/image.json",
    log:
        "results/logs/{flight}/{pair}.image.log",
    benchmark:
        "results/benchmarks/{flight}/{pair}.image.tsv"
    conda:
        "../../environment.yml"
    threads: 4
    resources:
        mem_mb=lambda wildcards, attempt: 3000 * attempt,
    params:
        settings=campaign.relevant("image"),
        code=code_sha256("apertura.steps.image"),
    message:
        "{wildcards.flight}: focusing {wildcards.pair} with {threads} threads"
    shell:
        "apertura step image {wildcards.flight} {wildcards.pair} --threads {threads} > {log} 2>&1"
