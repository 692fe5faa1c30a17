rule raw:
    input:
        lambda wildcards: [campaign.raw_files(wildcards.flight, wildcards.node)[role] for role in ("meta", "data")],
    output:
        "results/{flight}/{node}/raw.manifest.json",
    log:
        "results/logs/{flight}/{node}.raw.log",
    benchmark:
        "results/benchmarks/{flight}/{node}.raw.tsv"
    conda:
        "../../environment.yml"
    threads: 1
    resources:
        mem_mb=lambda wildcards, input: 300 + int(3 * input.size_mb),
    params:
        settings=campaign.relevant("raw"),
        code=code_sha256("apertura.steps.ingest"),
    message:
        "{wildcards.flight}: reading the recording of {wildcards.node}"
    shell:
        "apertura step raw {wildcards.flight} {wildcards.node} > {log} 2>&1"


rule track:
    input:
        lambda wildcards: campaign.track_file(wildcards.flight, wildcards.node),
    output:
        "results/{flight}/{node}/track.manifest.json",
    log:
        "results/logs/{flight}/{node}.track.log",
    benchmark:
        "results/benchmarks/{flight}/{node}.track.tsv"
    conda:
        "../../environment.yml"
    threads: 1
    resources:
        mem_mb=lambda wildcards, input: 300 + int(10 * input.size_mb),
    params:
        code=code_sha256("apertura.steps.ingest"),
    message:
        "{wildcards.flight}: reading the flight log of {wildcards.node}"
    shell:
        "apertura step track {wildcards.flight} {wildcards.node} > {log} 2>&1"
