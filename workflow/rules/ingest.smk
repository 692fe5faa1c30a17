rule ingest:
    input:
        lambda wildcards: list(campaign.raw_files(wildcards.flight, wildcards.node).values()),
    output:
        "results/{flight}/{node}/raw.manifest.json",
        "results/{flight}/{node}/track.manifest.json",
    log:
        "results/logs/{flight}/{node}.ingest.log",
    benchmark:
        "results/benchmarks/{flight}/{node}.ingest.tsv"
    conda:
        "../../environment.yml"
    threads: 1
    resources:
        mem_mb=lambda wildcards, input: 300 + int(3 * input.size_mb),
    params:
        settings=campaign.relevant("raw"),
        code=code_sha256("apertura.steps.ingest"),
    message:
        "{wildcards.flight}: reading the recording and flight log of {wildcards.node}"
    shell:
        "apertura step ingest {wildcards.flight} {wildcards.node} > {log} 2>&1"
